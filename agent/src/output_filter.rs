//! Output filter: a stage between an agent and what its node publishes.

use protocol::{PointCloud, PoseEstimate};

use crate::agent::Perception;

/// Changes what an agent computed before it is published. Each part passes unchanged unless a filter says otherwise.
pub trait OutputFilter: std::fmt::Debug + Send {
    /// The published pose.
    fn pose(&self, pose: PoseEstimate) -> PoseEstimate {
        pose
    }

    /// The published map, confidence and detections.
    fn perception(&mut self, perception: Perception) -> Perception {
        perception
    }

    /// The published points, in the LiDAR frame.
    fn points(&mut self, points: PointCloud) -> PointCloud {
        points
    }
}

/// Publishes what the agent computed.
#[derive(Debug, Clone, Copy, Default)]
pub struct Unfiltered;

impl OutputFilter for Unfiltered {}
