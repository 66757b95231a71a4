//! Detections of one agent from its own sensors.

use serde::{Deserialize, Serialize};

use super::{PoseEstimate, check_detections, metadata_only};
use crate::{Detection, Limits, WireError};

/// Detections of one agent: agent to ego, for late fusion.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Boxes {
    /// Pose of the sender.
    pub pose: PoseEstimate,
    /// Detections in the frame of the sender's LiDAR.
    pub detections: Vec<Detection>,
}

impl Boxes {
    fn check_values(&self, limits: &Limits) -> Result<(), WireError> {
        self.pose.check_values(limits)?;
        check_detections(&self.detections, limits)
    }
}

metadata_only!(Boxes, Boxes);
