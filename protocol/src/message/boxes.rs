//! What one agent detects alone.

use serde::{Deserialize, Serialize};

use super::{PoseEstimate, check_detections, metadata_only};
use crate::Detection;
use crate::Limits;
use crate::WireError;

/// Detections of one agent: agent to ego, for late fusion.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Boxes {
    /// Where the sender is.
    pub pose: PoseEstimate,
    /// What it sees, in the frame of its own LiDAR.
    pub detections: Vec<Detection>,
}

impl Boxes {
    fn check_values(&self, limits: &Limits) -> Result<(), WireError> {
        self.pose.check_values(limits)?;
        check_detections(&self.detections, limits)
    }
}

metadata_only!(Boxes, Boxes);
