//! Scores of frames that were evaluated offline or in simulation time.

use deploy::score::FrameScores;
use deploy::score::metrics::Metrics;
use ego_fuser_offline::evaluation::{EvaluatedFrame, Evaluator};
use protocol::CavId;

/// Scores a frame; if compute times are emulated, its stamp is the time of publication.
pub(crate) fn judge(scores: &mut FrameScores, frame: EvaluatedFrame, is_timed: bool) {
    let (stamp, frames) = (frame.stamp, frame.frames);
    let cavs = frames.iter().map(|frame| frame.cav.clone());
    let poses: Vec<_> = cavs.zip(frame.poses).collect();
    let world_from_lidar: Vec<(CavId, _)> = frames
        .iter()
        .filter_map(|frame| Some((frame.cav.clone(), frame.world_from_lidar?)))
        .collect();
    let latency_ms = is_timed.then(|| (stamp.publish_nanos - stamp.capture_nanos) as f64 / 1e6);
    scores.judge_whole(
        (frame.tick as u64, stamp.capture_nanos),
        latency_ms,
        // A frame that failed counts as unanswered, whatever its result holds.
        frame.failure.is_none().then_some(frame.result),
        &frame.truth,
        &poses,
        world_from_lidar,
    );
}

/// Metrics of an evaluation that took so many seconds on its clock, with the data that it left out.
pub(crate) fn metrics(
    scores: &FrameScores,
    evaluator: &Evaluator,
    clock: &str,
    pose_source: &str,
    seconds: f64,
) -> Metrics {
    let names = [evaluator.ego().method().name(), pose_source];
    let (ledger, sent_bytes) = (evaluator.ledger(), Some(evaluator.sent_bytes()));
    Metrics {
        left_out: evaluator.left_out().clone(),
        protocol: evaluator.protocol(),
        ..Metrics::of(scores, clock, names, seconds, ledger, sent_bytes)
    }
}
