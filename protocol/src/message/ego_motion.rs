//! Motion of a vehicle as its own sensors measure it.

use serde::{Deserialize, Serialize};

use super::{check_within, metadata_only};
use crate::Limits;
use crate::WireError;

/// Motion of a vehicle as its own sensors measure it at one time, wheels and IMU: replay to that vehicle's agent.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
pub struct EgoMotion {
    /// Speed along the heading, metres per second; negative backwards.
    pub speed_mps: Option<f64>,
    /// Yaw rate, radians per second, counter-clockwise.
    pub yaw_rate_rad_s: Option<f64>,
}

/// Largest speed of a message, metres per second.
const MAX_SPEED_MPS: f64 = 200.0;
/// Largest yaw rate of a message, radians per second.
const MAX_YAW_RATE_RAD_S: f64 = 20.0;

impl EgoMotion {
    fn check_values(&self, _: &Limits) -> Result<(), WireError> {
        check_within("speed_mps", self.speed_mps.unwrap_or(0.0), -MAX_SPEED_MPS, MAX_SPEED_MPS)?;
        check_within("yaw_rate_rad_s", self.yaw_rate_rad_s.unwrap_or(0.0), -MAX_YAW_RATE_RAD_S, MAX_YAW_RATE_RAD_S)
    }
}

metadata_only!(EgoMotion, Imu);
