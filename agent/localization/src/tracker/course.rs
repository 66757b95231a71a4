//! Course of a vehicle in the frame of its LiDAR: the direction of travel where it is clearly not the LiDAR's x axis.
//!
//! The motion filter estimates a course near the one it begins with; this one is found from the way between poses.

use std::f64::consts::PI;

use super::can_follow;
use super::measurement::PoseMeasurement;
use super::motion_filter::wrapped_rad;

/// Shortest way between two poses whose direction is compared: in metres, and in standard deviations of both positions,
/// for a direction to 0.05 rad.
const LEAST_WAY: [f64; 2] = [1.0, 20.0];
/// Angle to the course from which on a way leads elsewhere, radians: twice the deviation of the filter's. Two ways agree
/// within it.
const ELSEWHERE_RAD: f64 = 0.2;
/// Farthest place of a LiDAR ahead of the rear axle, metres: in turns it swings aside.
const MOST_LEVER_M: f64 = 4.0;
/// Angle to the course from which on a vehicle reverses, whatever the sign of its speed, radians.
const BACKWARD_RAD: f64 = 0.75 * PI;

/// Course of a vehicle, over all its tracks.
#[derive(Debug, Clone, Default)]
pub(super) struct Course {
    /// Direction of travel, radians from the LiDAR's x axis to its y axis.
    pub(super) rad: f64,
    /// True if the vehicle measures a negative speed.
    pub(super) is_backward: bool,
    /// Pose from which the next way begins.
    from: Option<PoseMeasurement>,
    /// Angle of the last way to the course, if it led elsewhere, radians.
    elsewhere_rad: Option<f64>,
}

impl Course {
    /// Compares the way to a measured pose with the course; true if the way, and that before it, set another one.
    pub(super) fn is_set_by(&mut self, pose: &PoseMeasurement) -> bool {
        let Some(from) = self.from.filter(|from| can_follow(from, pose)) else {
            self.from = Some(*pose);
            return false;
        };
        let moved = from.world_from_lidar.inv_mul(&pose.world_from_lidar);
        let way_m = moved.translation.x.hypot(moved.translation.y);
        let [least_m, least_stds] = LEAST_WAY;
        if way_m < least_m.max(least_stds * from.position_std_m.hypot(pose.position_std_m)) {
            return false;
        }
        self.from = Some(*pose);
        let turn_rad = moved.rotation.euler_angles().2;
        let off_rad = self.off_rad(moved.translation.y.atan2(moved.translation.x) - turn_rad / 2.0);
        let swung_rad = MOST_LEVER_M * turn_rad.abs() / way_m;
        let now = (off_rad.abs() > ELSEWHERE_RAD + swung_rad).then_some(off_rad);
        let before = std::mem::replace(&mut self.elsewhere_rad, now);
        let is_set = (before.zip(now))
            .is_some_and(|(before, now)| wrapped_rad(now - before).abs() <= ELSEWHERE_RAD);
        if is_set {
            self.rad += off_rad;
        }
        is_set
    }

    /// Angle from the course to that of a way, radians.
    fn off_rad(&self, way_rad: f64) -> f64 {
        let backward_rad = if self.is_backward { PI } else { 0.0 };
        let off_rad = wrapped_rad(way_rad + backward_rad - self.rad);
        match off_rad.abs() > BACKWARD_RAD {
            true => wrapped_rad(off_rad + PI),
            false => off_rad,
        }
    }
}
