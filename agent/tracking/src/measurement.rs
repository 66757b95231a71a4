//! Measurement: a detected box in the world frame with the covariance of its position.

use nalgebra::{Isometry3, Matrix2, Vector2};
use protocol::{Box3d, Detection, PlanarCovariance};

use crate::TrackerConfig;

/// Largest absolute coordinate or size of a box that is taken, metres, and heading, radians.
const MAX_ABS: f64 = 1e7;

/// A detection that can be used.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Measurement {
    /// Index of the detection in its list.
    pub(crate) detection: usize,
    /// The box in the world frame.
    pub(crate) box3d: Box3d,
    /// Confidence, 0..=1.
    pub(crate) score: f64,
    /// Covariance of the position in the plane of the world, square metres.
    pub(crate) noise_m2: Matrix2<f64>,
}

impl Measurement {
    /// The detection in the world; `None` if a number is not finite, beyond all bounds, or the score not within 0..=1.
    pub(crate) fn new(
        (index, detection): (usize, &Detection),
        world_from_ego: &Isometry3<f64>,
        pose_covariance: Option<&PlanarCovariance>,
        config: &TrackerConfig,
    ) -> Option<Self> {
        let found = &detection.box3d;
        let lengths = found.center_m.iter().chain(&found.size_m);
        let mut numbers = lengths.chain([&found.heading_rad]);
        let score = f64::from(detection.score);
        let is_usable = numbers.all(|number| number.abs() <= MAX_ABS)
            && found.size_m.iter().all(|size| *size >= 0.0)
            && (0.0..=1.0).contains(&score);
        if !is_usable {
            return None;
        }
        let box3d = detection.box3d.transformed(world_from_ego);
        let sigma_m =
            config.sigma_uncertain_m + (config.sigma_certain_m - config.sigma_uncertain_m) * score;
        let position = Vector2::new(box3d.center_m[0], box3d.center_m[1]);
        let offset_m = position - world_from_ego.translation.vector.xy();
        let of_pose =
            pose_covariance.map_or_else(Matrix2::zeros, |covariance| of_pose(covariance, offset_m));
        Some(Self {
            detection: index,
            box3d,
            score,
            noise_m2: Matrix2::identity() * (sigma_m * sigma_m) + of_pose,
        })
    }

    pub(crate) fn position_m(&self) -> Vector2<f64> {
        Vector2::new(self.box3d.center_m[0], self.box3d.center_m[1])
    }
}

/// Covariance that the pose of the ego adds to a position at `offset_m` from it: its own, and that of its yaw across
/// the line of sight. Numbers that are no covariance add nothing.
fn of_pose(pose: &PlanarCovariance, offset_m: Vector2<f64>) -> Matrix2<f64> {
    let numbers = [pose.xx_m2, pose.xy_m2, pose.yy_m2, pose.yaw_rad2];
    let [xx, xy, yy, yaw] = numbers.map(f64::from);
    // The tolerance covers the rounding of numbers in single precision.
    let is_covariance = xx >= 0.0 && yy >= 0.0 && yaw >= 0.0 && xy * xy <= xx * yy * (1.0 + 1e-4);
    if !is_covariance || !(xx + yy + yaw).is_finite() {
        return Matrix2::zeros();
    }
    // Displacement of the position per radian of yaw.
    let across = Vector2::new(-offset_m.y, offset_m.x);
    Matrix2::new(xx, xy, xy, yy) + across * across.transpose() * yaw
}

#[cfg(test)]
mod tests {
    use protocol::Pose;

    use super::*;

    fn detection(x: f64, score: f32) -> Detection {
        let box3d = Box3d {
            center_m: [x, 0.0, 0.0],
            size_m: [4.0, 2.0, 1.5],
            heading_rad: 0.0,
        };
        Detection {
            box3d,
            score,
            source: None,
        }
    }

    #[test]
    fn noise_is_that_of_score_position_and_yaw() {
        let world_from_ego = Pose::from_xyz_yaw([100.0, 50.0, 0.0], std::f64::consts::FRAC_PI_2);
        let covariance = PlanarCovariance {
            xx_m2: 0.25,
            xy_m2: 0.0,
            yy_m2: 0.5,
            yaw_rad2: 1e-4,
        };
        let config = TrackerConfig {
            sigma_certain_m: 0.5,
            ..TrackerConfig::default()
        };
        let measured = Measurement::new(
            (0, &detection(20.0, 1.0)),
            &world_from_ego.isometry(),
            Some(&covariance),
            &config,
        )
        .unwrap();
        // 20 m ahead of an ego that looks along y: the yaw moves the box along x, by 0.2 m.
        assert!((measured.position_m() - Vector2::new(100.0, 70.0)).norm() < 1e-12);
        let expected = Matrix2::new(0.25 + 0.25 + 0.04, 0.0, 0.0, 0.25 + 0.5);
        assert!((measured.noise_m2 - expected).amax() < 1e-6, "{measured:?}");
    }

    fn is_usable(detection: &Detection) -> bool {
        let config = TrackerConfig::default();
        Measurement::new((0, detection), &Isometry3::identity(), None, &config).is_some()
    }

    #[test]
    fn numbers_that_are_no_box_are_refused() {
        assert!(is_usable(&detection(1.0, 0.5)));
        for bad in [f64::NAN, f64::INFINITY, -1e30] {
            assert!(!is_usable(&detection(bad, 0.5)));
        }
        for bad in [f32::NAN, -0.1, 1.1] {
            assert!(!is_usable(&detection(1.0, bad)));
        }
    }
}
