//! Score of a run: detections against the truth, poses, latencies, bytes, and message accounting.

mod frame_record;
mod frame_scores;
mod live_precision;
pub mod metrics;
mod neighbours;
mod node;
mod numbered_results;
pub mod offline_intervals;
mod open_ticks;
mod precision;
mod result_lines;
mod stage_stamps;
mod true_boxes;
mod truth_line;

/// File of a run or evaluation with its tracks, if the ego tracks.
pub const TRACKS: &str = "tracks.jsonl";

pub use frame_record::{FrameRecord, JudgedFrame, StreamedResult};
pub use frame_scores::FrameScores;
pub use neighbours::NeighbourRecord;
pub(crate) use node::SCORER;
pub use node::{ProcessStats, Progress, Scored, ScorerError, ScorerNode, scorer_cav};
pub use result_lines::ScenarioLine;
pub use stage_stamps::StageStamps;
pub(crate) use stage_stamps::ms_between;
pub(crate) use true_boxes::ground_truth;
pub use truth_line::TruthLine;
