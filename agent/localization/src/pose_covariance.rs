//! Covariance of a localized pose: its shape from the residuals of the cells, its size from the confidence.

use nalgebra::{Matrix6, Vector6};

use crate::pgc::pose_solver::FoundPose;
use crate::tracker::PoseMeasurement;

/// Largest variance, square metres or radians: that of a pose that nothing constrains.
const MAX_VARIANCE: f64 = 1e6;

/// Covariance of x, y, z (metres) and of rotations about the world's x, y, z (radians), row by row, in ROS's order.
///
/// Residuals determine the ratios between axes; errors of neighbouring cells are correlated, so that their size is that
/// of a [`PoseMeasurement`]: the error which the fitted confidence stands for. That of a registered pose is its own.
pub fn pose_covariance(found: &FoundPose) -> [[f64; 6]; 6] {
    if found.is_registered {
        return found.cell_covariance;
    }
    let PoseMeasurement {
        position_std_m,
        yaw_std_rad,
        ..
    } = PoseMeasurement::new(0, found);
    let shape = Matrix6::from_fn(|row, column| found.cell_covariance[row][column]);
    let planar_variance = f64::midpoint(shape[(0, 0)], shape[(1, 1)]);
    let factor = |wanted_std: f64, variance: f64| match variance > 0.0 && variance < MAX_VARIANCE {
        true => wanted_std / variance.sqrt(),
        false => 1.0,
    };
    let position = factor(position_std_m, planar_variance);
    let rotation = factor(yaw_std_rad, shape[(5, 5)]);
    let scale = Matrix6::from_diagonal(&Vector6::new(
        position, position, position, rotation, rotation, rotation,
    ));
    let covariance = scale * shape * scale;
    std::array::from_fn(|row| {
        std::array::from_fn(|column| covariance[(row, column)].clamp(-MAX_VARIANCE, MAX_VARIANCE))
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::pgc::pose_solver::PoseSolver;
    use crate::pgc::synthetic::SyntheticScene;

    #[test]
    fn it_is_a_covariance_of_the_size_that_the_confidence_stands_for() {
        let found = PoseSolver::default()
            .solve(&SyntheticScene::default().coordinates(1))
            .unwrap();
        let covariance = pose_covariance(&found);
        let measured = PoseMeasurement::new(0, &found);
        let planar = f64::midpoint(covariance[0][0], covariance[1][1]);
        assert!(
            (planar.sqrt() - measured.position_std_m).abs() < 1e-9,
            "{covariance:?}"
        );
        assert!((covariance[5][5].sqrt() - measured.yaw_std_rad).abs() < 1e-9);
        let matrix = Matrix6::from_fn(|row, column| covariance[row][column]);
        assert!(
            (matrix - matrix.transpose()).amax() < 1e-9
                && matrix.symmetric_eigenvalues().min() > 0.0
        );
    }

    #[test]
    fn a_pose_that_nothing_constrains_has_the_largest_variance() {
        let mut found = PoseSolver::default()
            .solve(&SyntheticScene::default().coordinates(1))
            .unwrap();
        found.cell_covariance =
            std::array::from_fn(|row| std::array::from_fn(|c| if row == c { 1e6 } else { 0.0 }));
        assert_eq!(pose_covariance(&found)[0][0], MAX_VARIANCE);
    }
}
