//! Ticks that an ego reported on, and what it is worth over all of them.

use serde::{Deserialize, Serialize};

use super::ByIou;

/// Average precision over all ticks of a run, those that the ego left unanswered included.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
pub struct Answered {
    /// Ticks with detections.
    pub answered: u64,
    /// Ticks of the scene.
    pub ticks: u64,
    /// Average precision ordered by score, an unanswered tick being a frame without detections.
    pub ap_all_ticks: ByIou,
    /// Streaming average precision (Li et al. 2020, "Towards Streaming Perception"), ordered by score: at each tick the
    /// detections that were published last until then count, moved by the ego's true motion since their capture, against
    /// what is there now. Latency and unanswered ticks both lower it.
    pub streaming_ap: ByIou,
}
