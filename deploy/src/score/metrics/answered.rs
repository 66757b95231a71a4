//! Average precision over all ticks, those without a result included.

use serde::{Deserialize, Serialize};

use super::ByIou;

/// Average precision over all ticks of a run, those without a result included.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
pub struct Answered {
    /// Number of ticks with detections.
    pub answered: u64,
    /// Number of ticks of the scene.
    pub ticks: u64,
    /// Average precision ordered by score; a tick without a result is a frame without detections.
    pub ap_all_ticks: ByIou,
    /// Streaming average precision (Li et al. 2020, "Towards Streaming Perception"), ordered by score: at each tick the
    /// last detections published until then are moved by the ego's true motion since their capture and compared with
    /// the truth at that tick. Latency and missing results both lower it.
    pub streaming_ap: ByIou,
}
