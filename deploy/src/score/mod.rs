//! Score of a run: detections against the truth, poses, latencies, bytes, and message accounting.

pub(crate) mod evaluated_frame;
mod frame_lines;
mod frame_record;
mod frame_scores;
mod live_precision;
pub mod metrics;
mod neighbours;
mod node;
mod numbered_results;
pub(crate) mod offline_intervals;
mod open_ticks;
mod precision;
mod result_lines;
mod stage_stamps;
mod true_boxes;
mod truth_line;

pub(crate) use frame_lines::FrameLines;
pub use frame_record::FrameRecord;

pub(crate) use frame_record::{JudgedFrame, StreamedResult};
pub use frame_scores::FrameScores;
pub use neighbours::NeighbourRecord;
pub use node::{ProcessStats, Progress, Scored, ScorerError};
pub(crate) use node::{ScorerNode, scorer_cav};
pub(crate) use stage_stamps::StageStamps;
pub(crate) use true_boxes::true_objects;
pub use truth_line::TruthLine;
