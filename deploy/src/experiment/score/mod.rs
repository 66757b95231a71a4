//! What a run is worth: detections against the truth, poses, delays, bytes, and whether every message is accounted for.

mod frame_record;
mod frame_scores;
mod live_precision;
mod neighbours;
mod node;
mod numbered_results;
mod open_ticks;
mod result_lines;
mod stage_stamps;
mod true_boxes;

pub use frame_record::{FrameRecord, JudgedFrame};
pub use frame_scores::FrameScores;
pub use neighbours::NeighbourRecord;
pub use node::{ProcessBooks, Progress, Scored, ScorerError, ScorerNode, scorer_cav};
pub use stage_stamps::StageStamps;
pub use true_boxes::true_boxes;
