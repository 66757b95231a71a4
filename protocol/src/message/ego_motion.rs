//! Motion of a vehicle as its own sensors measure it.

use serde::{Deserialize, Serialize};

use super::{check_within, metadata_only};
use crate::{Limits, WireError};

/// Motion of a vehicle as its own sensors measure it at one time, wheels and IMU: replay to that vehicle's agent.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
pub struct EgoMotion {
    /// Speed along the heading, metres per second; negative backwards.
    pub speed_mps: Option<f64>,
    /// Yaw rate, radians per second, counter-clockwise: the mean since the last message, as a gyroscope that integrates
    /// between two messages gives it.
    pub yaw_rate_rad_s: Option<f64>,
}

impl EgoMotion {
    /// Largest speed of a message, metres per second.
    pub const MAX_SPEED_MPS: f64 = 200.0;
    /// Largest yaw rate of a message, radians per second.
    pub const MAX_YAW_RATE_RAD_S: f64 = 20.0;

    fn check_values(&self, _: &Limits) -> Result<(), WireError> {
        let most = Self::MAX_SPEED_MPS;
        check_within("speed_mps", self.speed_mps.unwrap_or(0.0), -most, most)?;
        let (turn, most) = (self.yaw_rate_rad_s.unwrap_or(0.0), Self::MAX_YAW_RATE_RAD_S);
        check_within("yaw_rate_rad_s", turn, -most, most)
    }
}

metadata_only!(EgoMotion, Imu);
