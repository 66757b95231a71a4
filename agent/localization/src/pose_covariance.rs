//! Covariance of a localized pose: its shape from the residuals of the cells or planes, its size fitted to known errors.

use nalgebra::Vector6;

use crate::covariance_scale::{MAX_VARIANCE, scaled};
use crate::pgc::pose_solver::FoundPose;
use crate::tracker::unscaled_std;

/// Covariance of x, y, z (metres) and of rotations about the world's x, y, z (radians), row by row, in ROS's order.
///
/// That of [`unscaled_covariance`] times the factors that were fitted, if they were ([`crate::covariance_scale`]).
pub fn pose_covariance(found: &FoundPose) -> [[f64; 6]; 6] {
    let unscaled = unscaled_covariance(found);
    let scale = found.covariance_scale;
    scale.map_or(unscaled, |scale| scale.applied(&unscaled))
}

/// Distance in the plane that at most one of 1,000 poses exceeds, metres; `None` where it was not fitted, and for a
/// registered pose whose start had no standard deviation: a bound that is fitted with starts would be too small for it.
pub fn position_bound_m(found: &FoundPose) -> Option<f64> {
    let scale = found.covariance_scale?;
    if found.is_registered && found.start_std_m == 0.0 {
        return None;
    }
    scale.bound_m(found.sigma, &unscaled_covariance(found), found.start_std_m)
}

/// The covariance without the fitted factors. Residuals determine its shape; its size is that of the unscaled deviations, the
/// error which the fitted confidence stands for. That of a registered pose is its own.
pub fn unscaled_covariance(found: &FoundPose) -> [[f64; 6]; 6] {
    if found.is_registered {
        return found.cell_covariance;
    }
    let [position_std_m, yaw_std_rad] = unscaled_std(found);
    let shape = &found.cell_covariance;
    let variance_m2 = f64::midpoint(shape[0][0], shape[1][1]);
    let position = (position_std_m, variance_m2);
    let rotation = (yaw_std_rad, shape[5][5]);
    // Cells that constrain nothing leave no shape to scale: their variance stays the largest.
    let [position, rotation] = [position, rotation].map(|(std, variance)| {
        if variance > 0.0 && variance < MAX_VARIANCE {
            std / variance.sqrt()
        } else {
            1.0
        }
    });
    let factors = [position, position, position, rotation, rotation, rotation];
    scaled(shape, &Vector6::from(factors))
}

#[cfg(test)]
mod tests {
    use nalgebra::Matrix6;

    use super::*;
    use crate::covariance_scale::CovarianceScale;
    use crate::pgc::pose_solver::PoseSolver;
    use crate::pgc::test_scene::SyntheticScene;

    fn found() -> FoundPose {
        let coordinates = SyntheticScene::default().coordinates(1);
        PoseSolver::default().solve(&coordinates).unwrap()
    }

    #[test]
    fn it_is_a_covariance_of_the_size_that_the_confidence_stands_for() {
        let found = found();
        let covariance = pose_covariance(&found);
        let [position_std_m, yaw_std_rad] = unscaled_std(&found);
        let planar = f64::midpoint(covariance[0][0], covariance[1][1]);
        assert!(
            (planar.sqrt() - position_std_m).abs() < 1e-9,
            "{covariance:?}"
        );
        assert!((covariance[5][5].sqrt() - yaw_std_rad).abs() < 1e-9);
        let matrix = Matrix6::from_fn(|row, column| covariance[row][column]);
        assert!(
            (matrix - matrix.transpose()).amax() < 1e-9
                && matrix.symmetric_eigenvalues().min() > 0.0
        );
    }

    #[test]
    fn a_pose_that_nothing_constrains_has_the_largest_variance() {
        let mut found = found();
        found.cell_covariance =
            std::array::from_fn(|row| std::array::from_fn(|c| if row == c { 1e6 } else { 0.0 }));
        assert_eq!(pose_covariance(&found)[0][0], MAX_VARIANCE);
    }

    #[test]
    fn fitted_factors_scale_its_standard_deviations() {
        let (mut found, factor) = (found(), 3.0);
        found.covariance_scale = Some(CovarianceScale {
            planar: factor,
            ..CovarianceScale::NONE
        });
        let (scaled, unscaled) = (pose_covariance(&found), unscaled_covariance(&found));
        assert!((scaled[0][1] - 9.0 * unscaled[0][1]).abs() < 1e-12);
        assert!((scaled[0][2] - 3.0 * unscaled[0][2]).abs() < 1e-12);
        assert_eq!(scaled[5][5], unscaled[5][5]);
        assert_eq!(position_bound_m(&found), None);
    }

    #[test]
    fn a_registered_pose_has_a_bound_only_where_the_deviation_of_its_start_is_known() {
        let mut found = found();
        found.covariance_scale = Some(CovarianceScale {
            bound: Some(4.0),
            ..CovarianceScale::NONE
        });
        assert!(position_bound_m(&found).is_some());
        found.is_registered = true;
        assert_eq!(position_bound_m(&found), None);
        found.start_std_m = 0.5;
        assert!(position_bound_m(&found).unwrap() >= 2.0);
    }
}
