//! Frame report: a result of an ego with the fields of its stamp, as JSON.

use serde::{Deserialize, Serialize};

use super::{Detections, Tracks};
use crate::Stamp;

/// A result with the fields of its [`Stamp`], as written to `detections/json` and `detections.jsonl`, `tracks/json` and
/// `tracks.jsonl`: one flat JSON object.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct FrameReport<T> {
    /// Tick of the scene, counted from 0, if known: the scorer knows it, the ego does not.
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
    pub result: T,
}

/// Detections of a frame with their stamp.
pub type DetectionsReport = FrameReport<Detections>;
/// Tracks of a frame with their stamp.
pub type TracksReport = FrameReport<Tracks>;

impl<T: Serialize> FrameReport<T> {
    /// The result of `stamp`'s frame, at a tick of the scene if that is known.
    pub fn new(stamp: &Stamp, tick: Option<u64>, result: T) -> Self {
        Self {
            tick,
            epoch: stamp.epoch,
            sequence: stamp.sequence,
            capture_nanos: stamp.capture_nanos,
            publish_nanos: stamp.publish_nanos,
            result,
        }
    }

    /// As JSON, on one line.
    pub fn to_json(&self) -> String {
        // Serialisation fails only for maps with keys that are not strings or a failing `Serialize`; neither occurs
        // here.
        serde_json::to_string(self).unwrap_or_default()
    }
}
