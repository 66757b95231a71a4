//! What the ego detected, and from whose data.

use serde::{Deserialize, Serialize};

use super::{
    PoseEstimate, StageTiming, check_count, check_detections, check_name, check_nanos, check_within, metadata_only,
};
use crate::CavId;
use crate::Detection;
use crate::DropReason;
use crate::Limits;
use crate::MisbehaviourReason;
use crate::Stamp;
use crate::WireError;

/// The result of one ego frame: ego-fuser to anyone, also as JSON.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Detections {
    /// The vehicle that fused, whose LiDAR frame the boxes are in.
    pub ego: CavId,
    /// Frame of the ego's own agent, counted from 0: the sequence of the agent's message that the frame began with; in
    /// virtual time, where every sweep is taken, ticks since the first. A number left out is a frame that was never
    /// decided. The same moment has the same capture time everywhere, but no vehicle knows the scene's tick.
    pub agent_frame: u64,
    /// Fusion method, as in the configuration.
    pub method: String,
    /// Where the ego believes to be.
    pub pose: PoseEstimate,
    /// What it detects, best first.
    pub detections: Vec<Detection>,
    /// Whose data were fused, the ego not counted.
    pub fused: Vec<FusedNeighbour>,
    /// Whose data could not be.
    pub skipped: Vec<SkippedNeighbour>,
    /// What the ego makes of the neighbours that it heard for this frame.
    pub heard: Vec<HeardNeighbour>,
    /// How long each stage took.
    pub stages: Vec<StageTiming>,
}

/// A neighbour whose data are in a result.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct FusedNeighbour {
    /// Who.
    pub cav: CavId,
    /// Capture time of the ego's sweep less that of the neighbour's, nanoseconds; negative where the neighbour's is the
    /// younger.
    pub age_nanos: i64,
    /// How sure the neighbour is of its pose, 0..=1.
    pub confidence: f32,
    /// Bytes of metadata and body of the message that was fused: map, boxes or points as they crossed the air.
    pub payload_bytes: u64,
    /// Bytes of everything it sent for this frame, headers and the pose's own message included.
    pub wire_bytes: u64,
}

/// A neighbour that is known but not in a result.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct SkippedNeighbour {
    /// Who.
    pub cav: CavId,
    /// Why; `None`: nothing has come from it for this frame.
    pub reason: Option<DropReason>,
}

/// A neighbour as the ego knows it.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct HeardNeighbour {
    /// Who.
    pub cav: CavId,
    /// How likely it is honest, 0..=1; `None` where the ego does not ask.
    pub trust: Option<f64>,
    /// Why it is left out, where it is not believed.
    pub doubt: Option<MisbehaviourReason>,
    /// Its clock less the ego's, less the shortest time a message of it was under way, seconds; `None` where there is but
    /// one clock.
    pub clock_offset_s: Option<f64>,
}

impl Detections {
    fn check_values(&self, limits: &Limits) -> Result<(), WireError> {
        check_name("method", &self.method)?;
        self.pose.check_values(limits)?;
        check_detections(&self.detections, limits)?;
        check_count("fused neighbours", self.fused.len(), limits.max_entries)?;
        check_count("skipped neighbours", self.skipped.len(), limits.max_entries)?;
        for neighbour in &self.fused {
            check_within("confidence", neighbour.confidence.into(), 0.0, 1.0)?;
            check_nanos("age_nanos", neighbour.age_nanos.unsigned_abs())?;
        }
        check_count("heard neighbours", self.heard.len(), limits.max_entries)?;
        for neighbour in &self.heard {
            check_within("trust", neighbour.trust.unwrap_or(0.0), 0.0, 1.0)?;
            // Whoever lies about the time may be off by all of it.
            check_within("clock offset", neighbour.clock_offset_s.unwrap_or(0.0), -1e11, 1e11)?;
        }
        StageTiming::check_all(&self.stages, limits)
    }
}

metadata_only!(Detections, Detections);

/// [`Detections`] together with who, which and when, as written to `detections/json` and `detections.jsonl`: one flat
/// JSON object.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct DetectionsReport {
    /// Tick of the scene, counted from 0, where the writer knows it: the scorer does, the ego does not.
    pub tick: Option<u64>,
    /// See [`Stamp::epoch`].
    pub epoch: u64,
    /// See [`Stamp::sequence`].
    pub sequence: u64,
    /// See [`Stamp::capture_nanos`].
    pub capture_nanos: u64,
    /// See [`Stamp::publish_nanos`].
    pub publish_nanos: u64,
    /// The result.
    #[serde(flatten)]
    pub result: Detections,
}

impl DetectionsReport {
    /// The result of `stamp`'s frame, at a tick of the scene where that is known.
    #[must_use]
    pub fn new(stamp: &Stamp, tick: Option<u64>, result: Detections) -> Self {
        let Stamp { cav: _, epoch, sequence, capture_nanos, publish_nanos } = *stamp;
        Self { tick, epoch, sequence, capture_nanos, publish_nanos, result }
    }

    /// As JSON, on one line.
    #[must_use]
    pub fn to_json(&self) -> String {
        // Neither a map with keys that are no strings nor a failing `Serialize` is in here: the only errors there are.
        serde_json::to_string(self).unwrap_or_default()
    }
}
