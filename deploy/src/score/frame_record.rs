//! Record of a scored frame.

use protocol::{Box3d, CavId, Detections, Pose};

use super::StageStamps;

/// One line of `frames.csv`: a tick of the scene, with or without a result of the ego.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct FrameRecord {
    /// Tick of the scene, counted from 0.
    pub tick: u64,
    /// Frame of the ego's own agent, see [`Detections::agent_frame`]; `None` if the tick is unanswered.
    pub agent_frame: Option<u64>,
    /// Capture time on the scene's clock, nanoseconds.
    pub capture_nanos: u64,
    /// From the publication of the tick to that of its detections, milliseconds; `None` without a result.
    pub latency_ms: Option<f64>,
    /// Time at which the frame passed each stage; all `None` without a result.
    pub stamps: StageStamps,
    /// Number of detected boxes that count.
    pub detected: usize,
    /// Number of true boxes.
    pub truth: usize,
    /// Number of detections that overlap a true box by at least 0.5.
    pub found: usize,
    /// Number of neighbours whose data are in the result.
    pub fused: usize,
    /// Number of neighbours whose data could not be fused, or that were out of range.
    pub skipped: usize,
    /// Age of the oldest fused data: capture time of the ego's sweep less that of the neighbour's, milliseconds; `None`
    /// if no neighbour was fused.
    pub oldest_ms: Option<f64>,
    /// Number of neighbours whose newest data were too old.
    pub stale: usize,
    /// Bytes of metadata and body of the fused messages, over all neighbours.
    pub payload_bytes: u64,
    /// Bytes of all messages that those neighbours sent for the frame.
    pub wire_bytes: u64,
    /// Distance of the ego's own pose from the truth, metres; empty if it had none.
    pub ego_error_m: Option<f64>,
    /// Angle of the ego's own pose to the truth, degrees.
    pub ego_error_deg: Option<f64>,
    /// The result that was the newest at this tick; `None` if there was none, or without times of publication.
    pub streamed: Option<StreamedResult>,
}

/// The last result that had been published by a tick, scored against the truth at that tick.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct StreamedResult {
    /// Tick of the sweep that it was made from.
    pub tick: u64,
    /// Time from that tick to this one, milliseconds.
    pub age_ms: f64,
    /// Number of its boxes that still count, moved by the ego's true motion.
    pub detected: usize,
    /// Number of these that overlap a true box by at least 0.5.
    pub found: usize,
}

impl FrameRecord {
    /// True if the ego has published a result of the tick.
    pub fn is_answered(&self) -> bool {
        self.agent_frame.is_some()
    }
}

/// A result and its ground truth, for pictures.
#[derive(Debug, Clone)]
pub struct JudgedFrame {
    /// Tick of the scene, counted from 0.
    pub tick: u64,
    /// Result of the ego.
    pub result: Detections,
    /// True boxes, in the ego's LiDAR frame.
    pub truth: Vec<Box3d>,
    /// True pose of every vehicle's LiDAR.
    pub world_from_lidar: Vec<(CavId, Pose)>,
}
