//! `truth.jsonl`: the ground truth of every tick as it was scored, so that all precisions can be computed anew.

use dataset::ground_truth::GroundTruth;
use protocol::{CavId, Pose};
use serde::{Deserialize, Serialize};

/// One line: the ground truth of a tick for one ego.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct TruthLine {
    /// Tick of the scene, counted from 0.
    pub tick: u64,
    /// Capture time on the scene's clock, nanoseconds.
    pub capture_nanos: u64,
    /// Time of publication, Unix nanoseconds; in simulation time the capture time.
    pub publish_nanos: u64,
    /// The vehicle whose detections are scored.
    pub ego: CavId,
    /// True pose of its LiDAR.
    pub world_from_ego: Option<Pose>,
    /// Objects that count, objects of other classes, and the range in which detections count, in its LiDAR frame.
    #[serde(flatten)]
    pub truth: GroundTruth,
}
