//! What a run is worth: detections against the truth, poses, delays, bytes, and whether every message is accounted for.

mod board;
mod node;

pub use board::{Board, FrameRecord, JudgedFrame, true_boxes};
pub use node::{ProcessBooks, Progress, Scored, ScorerError, ScorerNode, scorer_cav};
