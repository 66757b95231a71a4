//! Poses that are not computed by the method: recorded ones, those of a GNSS receiver, and those that a person states.

use serde::{Deserialize, Serialize};

use super::{check_pose, check_within, metadata_only};
use crate::{Limits, Pose, WireError};

/// A pose from outside, to that vehicle's agent: from the replay, or from the node of a ROS 2 network.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Gnss {
    /// Pose of the LiDAR.
    pub world_from_lidar: Pose,
    /// Standard deviation of each coordinate, metres; 0 for an exact source.
    pub position_std_m: f64,
    /// Standard deviation of the heading, radians.
    pub heading_std_rad: f64,
    /// Origin of the pose.
    pub source: GnssSource,
}

/// Origin of a recorded pose.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum GnssSource {
    /// The data set's own pose.
    Recorded,
    /// A satellite receiver, with its noise.
    Gnss,
    /// A person: where a tracker starts anew. No measurement of the sweep of that time.
    Stated,
}

impl Gnss {
    fn check_values(&self, _: &Limits) -> Result<(), WireError> {
        check_pose("world_from_lidar", &self.world_from_lidar)?;
        check_within("position_std_m", self.position_std_m, 0.0, 1e6)?;
        check_within("heading_std_rad", self.heading_std_rad, 0.0, 10.0)
    }
}

metadata_only!(Gnss, Gnss);
