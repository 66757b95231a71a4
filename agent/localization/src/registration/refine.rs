//! Refinement of a motion: iteratively re-weighted least squares.
//!
//! Every pair keeps its influence, the less the larger its residual (Geman and McClure 1987): with residual `r` and
//! scale `c` its weight is multiplied by `1 / (1 + r^2/c^2)^2`. A scale that starts wide and shrinks pulls a coarse
//! motion into place before only the best pairs count.

use nalgebra::{Isometry3, Vector3};

use super::kabsch::{Degenerate, PairMoments};

/// Pairs beyond this many scales weigh less than a hundredth and are left out.
pub(super) const CUTOFF_SCALES: f64 = 3.0;
/// Step below which the iteration has converged: metres and radians.
const CONVERGED: f64 = 1e-4;

/// A point of the source, the same point of the target, and their weight.
pub(crate) type WeightedPair = (Vector3<f64>, Vector3<f64>, f64);

/// Re-fits a motion once for every scale of `scales_m`, in turn.
///
/// `pairs` are source point, target point and weight, all finite.
///
/// # Errors
/// [`Degenerate`] when the pairs near the motion do not constrain it.
pub(crate) fn reweighted(
    pairs: &[WeightedPair],
    start: &Isometry3<f64>,
    scales_m: impl IntoIterator<Item = f64>,
) -> Result<Isometry3<f64>, Degenerate> {
    let mut scales_m = scales_m.into_iter();
    scales_m.try_fold(*start, |motion, scale_m| step(pairs, &motion, scale_m))
}

/// Re-fits a motion at one scale until it converges, at most `max_steps` times.
pub(crate) fn converge(
    pairs: &[WeightedPair],
    start: &Isometry3<f64>,
    scale_m: f64,
    max_steps: usize,
) -> Result<Isometry3<f64>, Degenerate> {
    let mut motion = *start;
    for _ in 0..max_steps {
        let next = step(pairs, &motion, scale_m)?;
        let moved_m = (next.translation.vector - motion.translation.vector).norm();
        let turned_rad = next.rotation.angle_to(&motion.rotation);
        motion = next;
        if moved_m < CONVERGED && turned_rad < CONVERGED {
            break;
        }
    }
    Ok(motion)
}

/// Robust kernel: factor on a pair's weight, 0..=1.
pub(crate) fn forgiveness(residual_m: f64, scale_m: f64) -> f64 {
    let scaled = residual_m / scale_m;
    if scaled < CUTOFF_SCALES {
        (1.0 + scaled * scaled).powi(-2)
    } else {
        0.0
    }
}

/// One weighted fit with the weights of the residuals of `motion`.
fn step(
    pairs: &[WeightedPair],
    motion: &Isometry3<f64>,
    scale_m: f64,
) -> Result<Isometry3<f64>, Degenerate> {
    let rotation = motion.rotation.to_rotation_matrix();
    let mut moments = PairMoments::default();
    for (source_m, target_m, weight) in pairs {
        let residual = rotation * source_m + motion.translation.vector - target_m;
        // The weights are those of the motion before the step, so that the fit has a closed form.
        let kernel = forgiveness(residual.norm(), scale_m);
        if kernel > 0.0 {
            moments.add(source_m, target_m, weight * kernel);
        }
    }
    moments.fit()
}

#[cfg(test)]
mod tests {
    use nalgebra::Vector3;

    use super::*;
    use crate::registration::test_problem::TestProblem;

    fn pairs(problem: &TestProblem) -> Vec<(Vector3<f64>, Vector3<f64>, f64)> {
        let pairs = problem.pairs.iter().map(|pair| {
            let [source, target] =
                [pair.source_m, pair.target_m].map(|point| Vector3::from(point.map(f64::from)));
            (source, target, 1.0)
        });
        pairs.collect()
    }

    #[test]
    fn a_coarse_motion_is_refined_among_outliers() {
        let problem = TestProblem {
            count: 600,
            outliers: 0.5,
            noise_m: 0.2,
            ..TestProblem::default()
        }
        .drawn(1);
        let off = Isometry3::new(Vector3::new(1.2, -0.8, 0.5), Vector3::new(0.01, 0.0, 0.04));
        let coarse = problem.truth * off;
        let refined = reweighted(&pairs(&problem), &coarse, [4.0, 2.0, 1.0]).unwrap();
        let refined = converge(&pairs(&problem), &refined, 0.5, 20).unwrap();
        let (metres, degrees) = problem.error(&refined);
        assert!(
            metres < 0.06 && degrees < 0.1,
            "{metres} m, {degrees} degrees"
        );
    }

    #[test]
    fn no_pair_near_is_an_error() {
        let problem = TestProblem::default().drawn(2);
        let elsewhere = Isometry3::translation(0.0, 0.0, 1e4);
        assert_eq!(
            converge(&pairs(&problem), &elsewhere, 1.0, 5),
            Err(Degenerate::NoWeight(0.0))
        );
    }
}
