//! Output filter: a stage between an agent and the output that its node publishes.

use protocol::{PointCloud, PoseEstimate};

use crate::agent::Perception;

/// Changes the output of an agent before it is published. By default each part passes unchanged.
pub trait OutputFilter: std::fmt::Debug + Send {
    /// True if the filter may read confidence or detections.
    fn reads_head(&self) -> bool {
        true
    }

    /// The published pose.
    fn pose(&self, pose: PoseEstimate) -> PoseEstimate {
        pose
    }

    /// The published feature map, confidence and detections.
    fn perception(&mut self, perception: Perception) -> Perception {
        perception
    }

    /// The published points, in the LiDAR frame.
    fn points(&mut self, points: PointCloud) -> PointCloud {
        points
    }
}

/// Publishes the output unchanged.
#[derive(Debug, Clone, Copy, Default)]
pub struct Unfiltered;

impl OutputFilter for Unfiltered {
    fn reads_head(&self) -> bool {
        false
    }
}
