//! What is kept of a judged frame.

use protocol::{Box3d, CavId, Detections, Pose};
use serde::Serialize;

use super::StageStamps;

/// One line of `frames.csv`.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct FrameRecord {
    /// Tick of the scene, counted from 0.
    pub tick: u64,
    /// Frame of the ego's own agent, see [`Detections::agent_frame`].
    pub agent_frame: u64,
    /// Capture time on the scene's clock, nanoseconds.
    pub capture_nanos: u64,
    /// From the publication of the tick to that of its detections, milliseconds; none where nothing was published.
    pub latency_ms: Option<f64>,
    /// When the frame passed each stage; all open where nothing was published.
    pub stamps: StageStamps,
    /// Boxes detected.
    pub detected: usize,
    /// Boxes there were.
    pub truth: usize,
    /// Detections that overlap a true box by at least 0.5.
    pub found: usize,
    /// Neighbours whose data are in the result.
    pub fused: usize,
    /// Neighbours whose data could not be, or that were out of range.
    pub skipped: usize,
    /// Age of the oldest of what was fused: capture time of the ego's sweep less that of the neighbour's, milliseconds; none
    /// where nothing was.
    pub oldest_ms: Option<f64>,
    /// Neighbours whose newest data were too old.
    pub stale: usize,
    /// Bytes of metadata and body of what was fused, over all neighbours.
    pub payload_bytes: u64,
    /// Bytes of everything those neighbours sent for it.
    pub wire_bytes: u64,
    /// Distance of the ego's own pose from the truth, metres; empty where it had none.
    pub ego_error_m: Option<f64>,
    /// Angle of the ego's own pose to the truth, degrees.
    pub ego_error_deg: Option<f64>,
}

/// A result and what it was judged against, for pictures.
#[derive(Debug, Clone)]
pub struct JudgedFrame {
    /// Tick of the scene, counted from 0.
    pub tick: u64,
    /// The ego's result.
    pub result: Detections,
    /// What was there, in the ego's LiDAR frame.
    pub truth: Vec<Box3d>,
    /// True pose of every vehicle's LiDAR.
    pub world_from_lidar: Vec<(CavId, Pose)>,
}
