//! Motion of a vehicle as its own sensors measure it.

use serde::{Deserialize, Serialize};

/// Motion of a vehicle as its own sensors measure it at one time: wheels and IMU.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
pub struct EgoMotion {
    /// Speed along the heading, metres per second; negative backwards.
    pub speed_mps: Option<f64>,
    /// Yaw rate, radians per second, counter-clockwise.
    pub yaw_rate_rad_s: Option<f64>,
}
