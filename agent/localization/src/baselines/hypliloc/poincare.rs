//! Poincare ball: maps between the ball and its tangent space at the origin (Ganea et al. 2018).

use tch::{Kind, Tensor};

/// Curvature of the ball, negated: its radius is 1 / sqrt(c).
const CURVATURE: f64 = 0.1;
/// Largest distance from the origin as a share of the radius, for single precision.
const MAX_SHARE: f64 = 0.999;
/// Added to squared norms, so that the gradient at the origin is finite.
const TINY: f64 = 1e-12;

/// Exponential map at the origin: tangent vectors along the last dimension to points of the ball.
pub(super) fn expmap0(tangent: &Tensor) -> tch::Result<Tensor> {
    let scaled = scaled_norm(tangent)?;
    // In single precision the hyperbolic tangent reaches 1, where the inverse is infinite.
    let share = scaled.f_tanh()?.f_clamp_max(MAX_SHARE)?;
    tangent.f_mul(&(share / scaled))
}

/// Logarithm at the origin, the inverse of [`expmap0`].
pub(super) fn logmap0(point: &Tensor) -> tch::Result<Tensor> {
    let scaled = scaled_norm(point)?;
    let length = scaled.f_clamp_max(MAX_SHARE)?.f_atanh()?;
    point.f_mul(&(length / scaled))
}

/// Norms along the last dimension, in units of the radius.
fn scaled_norm(x: &Tensor) -> tch::Result<Tensor> {
    (x.f_square()?.f_sum_dim_intlist(-1_i64, true, Kind::Float)? * CURVATURE)
        .f_add_scalar(TINY)?
        .f_sqrt()
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    proptest! {
        #[test]
        fn the_logarithm_is_the_inverse_of_the_exponential(tangent in proptest::array::uniform4(-4.0f32..4.0)) {
            let tangent = Tensor::from_slice(&tangent);
            let point = expmap0(&tangent).unwrap();
            prop_assert!(point.norm().double_value(&[]) < 1.0 / CURVATURE.sqrt());
            prop_assert!(logmap0(&point).unwrap().allclose(&tangent, 1e-3, 1e-4, false));
        }
    }

    #[test]
    fn far_vectors_stay_in_the_ball_and_gradients_at_the_origin_are_finite() {
        let far = expmap0(&Tensor::from_slice(&[1e4f32, 0.0])).unwrap();
        assert!((far.double_value(&[0]) - MAX_SHARE / CURVATURE.sqrt()).abs() < 1e-4);
        assert!(logmap0(&far).unwrap().isfinite().all().int64_value(&[]) == 1);
        let origin = Tensor::from_slice(&[0f32, 0.0]).set_requires_grad(true);
        logmap0(&expmap0(&origin).unwrap())
            .unwrap()
            .sum(Kind::Float)
            .backward();
        assert!(origin.grad().isfinite().all().int64_value(&[]) == 1);
    }
}
