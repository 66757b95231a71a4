//! Detections of an ego, with the neighbours that contributed.

use serde::{Deserialize, Serialize};

use super::{
    PoseEstimate, StageTiming, check_count, check_detection, check_nanos, check_text, check_within,
    metadata_only,
};
use crate::{CavId, Detection, DropReason, Limits, MisbehaviourReason, WireError};

/// The result of one ego frame: ego-fuser to anyone, also as JSON.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Detections {
    /// The vehicle that fused; the boxes are in its LiDAR frame.
    pub ego: CavId,
    /// Frame of the ego's own agent, counted from 0: the sequence of the agent's message with which the frame began; in
    /// simulation time, where every sweep is used, ticks since the first. A missing number is a frame for which no
    /// result was computed. One capture time is the same in all vehicles, but no vehicle has the tick of the scene.
    pub agent_frame: u64,
    /// Fusion method, as in the configuration.
    pub method: String,
    /// Pose estimate of the ego.
    pub pose: PoseEstimate,
    /// Detections, by descending score.
    pub detections: Vec<Detection>,
    /// Neighbours whose data were fused, without the ego.
    pub fused: Vec<FusedNeighbour>,
    /// Neighbours whose data were not fused.
    pub skipped: Vec<SkippedNeighbour>,
    /// Misbehaviour detection and clock offset of each neighbour that sent data for this frame, and of each whose capture
    /// clock differs from the ego's.
    pub neighbours: Vec<NeighbourState>,
    /// Durations of the stages.
    pub stages: Vec<StageTiming>,
}

/// A neighbour whose data are in a result.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct FusedNeighbour {
    /// Id of the neighbour.
    pub cav: CavId,
    /// Capture time of the ego's sweep minus that of the neighbour's, nanoseconds; negative if the neighbour's is
    /// newer.
    pub age_nanos: i64,
    /// Confidence of the neighbour's pose, 0..=1.
    pub confidence: f32,
    /// Bytes of metadata and body of the message that was fused: feature map, boxes or points as transmitted.
    pub payload_bytes: u64,
    /// Bytes of all its messages for this frame, headers and the pose message included.
    pub wire_bytes: u64,
}

/// A neighbour that is known but not in a result.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct SkippedNeighbour {
    /// Id of the neighbour.
    pub cav: CavId,
    /// Drop reason; `None`: nothing has arrived from it for this frame.
    pub reason: Option<DropReason>,
}

/// State of a neighbour at the ego.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct NeighbourState {
    /// Id of the neighbour.
    pub cav: CavId,
    /// Trust score (probability of being honest), 0..=1; `None` without misbehaviour detection.
    pub trust: Option<f64>,
    /// Misbehaviour reason, if it is excluded.
    pub misbehaviour: Option<MisbehaviourReason>,
    /// Its clock minus the ego's, minus the shortest transit time of its messages, seconds; `None` if both share one
    /// clock.
    pub clock_offset_s: Option<f64>,
    /// Its capture times minus the ego's at one moment, seconds: the offset that the ego corrects; `None` if they agree
    /// within 50 ms.
    pub capture_offset_s: Option<f64>,
}

impl NeighbourState {
    /// A vehicle of which nothing is known.
    pub fn new(cav: CavId) -> Self {
        Self {
            cav,
            trust: None,
            misbehaviour: None,
            clock_offset_s: None,
            capture_offset_s: None,
        }
    }
}

impl Detections {
    fn check_values(&self, limits: &Limits) -> Result<(), WireError> {
        check_text("method", &self.method)?;
        self.pose.check_values(limits)?;
        check_count("detections", self.detections.len(), limits.max_boxes)?;
        self.detections.iter().try_for_each(check_detection)?;
        check_count("fused neighbours", self.fused.len(), limits.max_entries)?;
        check_count("skipped neighbours", self.skipped.len(), limits.max_entries)?;
        for neighbour in &self.fused {
            check_within("confidence", neighbour.confidence.into(), 0.0, 1.0)?;
            check_nanos("age_nanos", neighbour.age_nanos.unsigned_abs())?;
        }
        check_count("neighbours", self.neighbours.len(), limits.max_entries)?;
        for neighbour in &self.neighbours {
            check_within("trust", neighbour.trust.unwrap_or(0.0), 0.0, 1.0)?;
            // The clock of an attacker may be wrong by any amount.
            for (name, offset_s) in [
                ("clock offset", neighbour.clock_offset_s),
                ("capture offset", neighbour.capture_offset_s),
            ] {
                check_within(name, offset_s.unwrap_or(0.0), -1e11, 1e11)?;
            }
        }
        StageTiming::check_all(&self.stages, limits)
    }
}

metadata_only!(Detections, Detections);
