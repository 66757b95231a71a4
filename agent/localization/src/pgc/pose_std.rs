//! Standard deviation of a fitted pose, from the cells that it was fitted to.

use nalgebra::{Isometry3, Matrix6, SMatrix, Vector3};

use crate::registration::Correspondence;

/// Standard deviations of a pose.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct PoseStd {
    /// Standard deviation of the position, all axes together, metres.
    pub(super) position_m: f64,
    /// Standard deviation of the position along its worst axis, metres: along the road, mostly.
    pub(super) worst_axis_m: f64,
    /// Standard deviation of the orientation, all axes together, radians.
    pub(super) rotation_rad: f64,
    /// Covariance of position (metres) and rotation about the axes of the world (radians), in this order.
    pub(super) covariance: [[f64; 6]; 6],
}

impl PoseStd {
    /// Value for cells that do not constrain the pose.
    pub(super) fn unbounded() -> Self {
        Self {
            position_m: 1e3,
            worst_axis_m: 1e3,
            rotation_rad: 1e3,
            covariance: Matrix6::from_diagonal_element(1e6).data.0,
        }
    }

    /// Standard deviations of the weighted fit of `target_from_source` to pairs, each with its weight there.
    ///
    /// The sandwich estimator of White (1980), `A B A` with the inverse of the normal equations `A` and the outer
    /// products of the pairs' gradients `B`: pairs may differ in their errors. Errors of neighbouring cells are
    /// correlated, which makes it too small by a factor, but the ratio between sweeps is right.
    pub(super) fn of<'a>(
        target_from_source: &Isometry3<f64>,
        pairs: impl Iterator<Item = (&'a Correspondence, f64)>,
    ) -> Self {
        let (mut information, mut gradients) = (Matrix6::zeros(), Matrix6::zeros());
        for (pair, weight) in pairs {
            let arm = target_from_source.rotation * Vector3::from(pair.source_m.map(f64::from));
            let residual = arm + target_from_source.translation.vector
                - Vector3::from(pair.target_m.map(f64::from));
            // d(residual) = dt + dw x arm, for a small rotation dw about the sensor.
            let mut jacobian = SMatrix::<f64, 3, 6>::identity();
            jacobian
                .fixed_columns_mut::<3>(3)
                .copy_from(&-arm.cross_matrix());
            information += jacobian.transpose() * jacobian * weight;
            let gradient = jacobian.transpose() * residual * weight;
            gradients += gradient * gradient.transpose();
        }
        let unbounded = Self::unbounded();
        let Some(inverse) = information.try_inverse() else {
            return unbounded;
        };
        let covariance = inverse * gradients * inverse;
        let [position_m2, rotation_rad2] =
            [0..3, 3..6].map(|axes| axes.map(|axis| covariance[(axis, axis)]).sum());
        let position = covariance.fixed_view::<3, 3>(0, 0);
        // A matrix that is not finite has no eigenvalues.
        let is_finite = position.iter().all(|entry| entry.is_finite());
        let worst_axis = is_finite.then(|| position.into_owned().symmetric_eigenvalues().max());
        Self {
            position_m: bounded_std(position_m2, unbounded.position_m),
            worst_axis_m: bounded_std(worst_axis.unwrap_or(f64::NAN), unbounded.worst_axis_m),
            rotation_rad: bounded_std(rotation_rad2, unbounded.rotation_rad),
            covariance: match covariance.iter().all(|entry| entry.is_finite()) {
                true => covariance.transpose().data.0,
                false => unbounded.covariance,
            },
        }
    }
}

fn bounded_std(variance: f64, most: f64) -> f64 {
    let std = variance.sqrt();
    // NaN, of a variance that rounding left below zero, counts as unbounded too.
    if std.is_finite() { std.min(most) } else { most }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::registration::kabsch::PairMoments;
    use crate::registration::test_problem::TestProblem;

    #[test]
    fn it_matches_the_spread_of_fits() {
        let (mut square_m, mut expected_m) = (0.0_f64, 0.0_f64);
        for seed in 0..200 {
            let problem = TestProblem {
                count: 80,
                outliers: 0.0,
                noise_m: 0.3,
                ..TestProblem::default()
            }
            .drawn(seed);
            let mut moments = PairMoments::default();
            for pair in &problem.pairs {
                let [source, target] =
                    [pair.source_m, pair.target_m].map(|point| Vector3::from(point.map(f64::from)));
                moments.add(&source, &target, 1.0);
            }
            let fitted = moments.fit().unwrap();
            let (off_m, _) = problem.error(&fitted);
            square_m += off_m * off_m / 200.0;
            expected_m += PoseStd::of(&fitted, problem.pairs.iter().map(|pair| (pair, 1.0)))
                .position_m
                / 200.0;
        }
        let ratio = expected_m / square_m.sqrt();
        assert!((0.75..1.25).contains(&ratio), "{ratio}");
    }

    /// Standard deviation of the identity, of pairs that are off by plus or minus this distance along each axis.
    fn std_of_identity(noise_m: [f64; 3]) -> PoseStd {
        let pairs = (0..200_i32).map(|k| {
            let source_m = [
                (k % 10) as f32 * 4.0 - 18.0,
                (k / 10) as f32 * 3.0 - 28.0,
                (k % 7) as f32,
            ];
            let target_m = std::array::from_fn(|axis| {
                let is_negative = ((k * 2_654_435) >> (axis as i32 + 4)) & 1 == 0;
                let sign = if is_negative { -1.0 } else { 1.0 };
                source_m[axis] + (sign * noise_m[axis]) as f32
            });
            Correspondence {
                source_m,
                target_m,
                weight: 1.0,
            }
        });
        let pairs: Vec<Correspondence> = pairs.collect();
        PoseStd::of(&Isometry3::identity(), pairs.iter().map(|pair| (pair, 1.0)))
    }

    #[test]
    fn the_worst_axis_is_the_one_along_which_residuals_are_large() {
        let [even, long] = [[0.2; 3], [0.8, 0.2, 0.2]].map(std_of_identity);
        assert!(even.worst_axis_m < even.position_m && long.worst_axis_m < long.position_m);
        assert!(
            long.worst_axis_m > 2.5 * even.worst_axis_m,
            "{even:?} {long:?}"
        );
    }

    #[test]
    fn no_pairs_constrain_nothing() {
        assert_eq!(
            PoseStd::of(&Isometry3::identity(), std::iter::empty()),
            PoseStd::unbounded()
        );
    }
}
