//! Error of a pose: distance and angle to the true one.

use crate::Pose;

/// Error of one pose.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PoseError {
    /// Distance to the true position, metres.
    pub distance_m: f64,
    /// Angle to the true orientation, degrees.
    pub angle_deg: f64,
}

impl PoseError {
    /// Error of `found` against `truth`; both are poses in the same world.
    pub fn between(found: &Pose, truth: &Pose) -> Self {
        let difference = truth.isometry().inv_mul(&found.isometry());
        Self {
            distance_m: difference.translation.vector.norm(),
            angle_deg: difference.rotation.angle().to_degrees(),
        }
    }
}

#[cfg(test)]
mod tests {
    use std::f64::consts::FRAC_PI_2;

    use super::*;

    #[test]
    fn a_pose_error_is_distance_and_angle() {
        let truth = Pose::from_xyz_yaw([1.0, 2.0, 0.0], 0.0);
        let found = Pose::from_xyz_yaw([4.0, 6.0, 0.0], FRAC_PI_2);
        let error = PoseError::between(&found, &truth);
        assert!((error.distance_m - 5.0).abs() < 1e-12 && (error.angle_deg - 90.0).abs() < 1e-9);
    }
}
