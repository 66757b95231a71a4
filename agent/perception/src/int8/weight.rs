//! Quantised weights: seven bits and a power of two per output channel.

use tch::{Kind, TchError, Tensor};

use super::scale::Scale;

/// Largest absolute value of a quantised weight.
pub const MAX_WEIGHT: i64 = 63;

/// Weights of one layer.
#[derive(Debug)]
pub(super) struct QuantisedWeight {
    /// `s8`, in the shape of the weight.
    pub(super) steps: Tensor,
    /// `[output channels]`, `f32`: powers of two.
    pub(super) scales: Tensor,
    /// `[output channels]`, `i32`: zero points, all 0.
    pub(super) zero_points: Tensor,
}

impl QuantisedWeight {
    /// Quantises a weight `[output channels, ...]`; of two scales per channel that with the smaller squared error is
    /// taken: the one that reaches the largest weight, and the next finer one, which clamps it.
    pub(super) fn new(weight: &Tensor) -> Result<Self, TchError> {
        let outputs = weight.size().first().copied().unwrap_or(0);
        let rows = weight.f_to_kind(Kind::Float)?.f_reshape([outputs, -1])?;
        let largest = rows.f_abs()?.f_amax([1_i64], false)?;
        let largest = Vec::<f64>::try_from(largest.f_to_kind(Kind::Double)?)?;
        let (mut steps, mut scales) = (Vec::new(), Vec::new());
        for (row, largest) in (0..outputs).zip(largest) {
            let row = rows.f_get(row)?;
            let wide = match largest > 0.0 {
                true => Scale::reaching(largest, MAX_WEIGHT as f64),
                false => Scale::of_exponent(0),
            };
            let (of_wide, wide_error) = quantised(&row, wide)?;
            let (of_finer, finer_error) = quantised(&row, wide.finer())?;
            let (of_row, scale) = match finer_error < wide_error {
                true => (of_finer, wide.finer()),
                false => (of_wide, wide),
            };
            steps.push(of_row);
            scales.push(scale.step() as f32);
        }
        let steps = Tensor::f_stack(&steps, 0)?.f_to_kind(Kind::Int8)?;
        Ok(Self {
            steps: steps.f_reshape(weight.size())?,
            zero_points: Tensor::f_zeros([outputs], (Kind::Int, weight.device()))?,
            scales: Tensor::f_from_slice(&scales)?,
        })
    }
}

/// Steps of a row, and its squared error.
fn quantised(row: &Tensor, scale: Scale) -> Result<(Tensor, f64), TchError> {
    let steps = row.f_mul_scalar(scale.step().recip())?.f_round()?;
    let steps = steps.f_clamp(-MAX_WEIGHT, MAX_WEIGHT)?;
    let error = steps.f_mul_scalar(scale.step())?.f_sub(row)?;
    let error = error.f_square()?.f_sum(Kind::Double)?;
    Ok((steps, error.f_double_value(&[])?))
}

#[cfg(test)]
mod tests {
    use tch::Device;

    use super::*;

    #[test]
    fn each_output_channel_has_its_own_power_of_two() {
        let weight = Tensor::from_slice(&[0.5_f32, -0.25, 0.0, 0.0, 1e-3, 63e-3]).view([3, 2]);
        let quantised = QuantisedWeight::new(&weight).unwrap();
        let scales = Vec::<f32>::try_from(&quantised.scales).unwrap();
        assert_eq!(scales, [-6.0_f32, 0.0, -9.0].map(f32::exp2));
        let steps = Vec::<i8>::try_from(quantised.steps.view([-1])).unwrap();
        assert_eq!(steps, [32, -16, 0, 0, 1, 32]);
    }

    #[test]
    fn weights_are_within_half_a_step_or_clamped() {
        tch::manual_seed(1);
        let weight = Tensor::randn([16, 8, 3, 3], (Kind::Float, Device::Cpu));
        let quantised = QuantisedWeight::new(&weight).unwrap();
        assert_eq!(quantised.steps.size(), weight.size());
        assert!(quantised.steps.abs().max().int64_value(&[]) <= MAX_WEIGHT);
        let scales = quantised.scales.view([16, 1, 1, 1]);
        let off = (quantised.steps.to_kind(Kind::Float) * &scales - &weight).abs() / &scales;
        let within = off
            .le(0.5)
            .to_kind(Kind::Float)
            .mean(Kind::Float)
            .double_value(&[]);
        assert!(within > 0.99, "{within}");
    }
}
