//! Scores of frames that were evaluated offline or in simulation time.

use deploy::score::FrameScores;
use deploy::score::metrics::Metrics;
use ego_fuser_offline::evaluation::{EvaluatedFrame, Evaluator};
use protocol::CavId;

/// Scores a frame; if it `is_timed`, its stamp is the time of publication.
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
    let names = [evaluator.ego.method().name(), pose_source];
    let (ledger, sent_bytes) = (&evaluator.ledger, Some(evaluator.sent_bytes));
    let mut metrics = Metrics {
        protocol: evaluator.protocol(),
        ..Metrics::of(scores, clock, names, seconds, ledger, sent_bytes)
    };
    metrics.left_out.merge(&evaluator.left_out);
    metrics
}

#[cfg(test)]
mod tests {
    use dataset::frame::Frame;
    use dataset::ground_truth::{GroundTruth, GroundTruthRule};
    use localization::pose_source::NO_SOURCE;
    use protocol::{Detections, Handedness, Pose, Stamp};

    use super::*;
    use crate::frame_lines::FrameLines;

    const RULE: GroundTruthRule = GroundTruthRule::OPV2V;

    fn ego() -> CavId {
        CavId::new("1").unwrap()
    }

    /// A frame of the ego alone, without objects.
    fn frame(tick: usize, world_from_lidar: Option<Pose>) -> EvaluatedFrame {
        let capture_nanos = 100_000_000 * tick as u64;
        let recorded = Frame {
            world_from_lidar,
            ..Frame::empty(ego(), capture_nanos, Handedness::Right)
        };
        EvaluatedFrame {
            tick,
            stamp: Stamp {
                cav: ego(),
                epoch: 0,
                sequence: 0,
                capture_nanos,
                publish_nanos: capture_nanos,
            },
            result: Detections {
                ego: ego(),
                agent_frame: tick as u64,
                method: "late".into(),
                pose: NO_SOURCE,
                detections: Vec::new(),
                fused: Vec::new(),
                skipped: Vec::new(),
                neighbours: Vec::new(),
                stages: Vec::new(),
            },
            tracks: None,
            failure: None,
            truth: GroundTruth::of_tick(&[&recorded], 0, &RULE),
            frames: vec![recorded],
            poses: vec![NO_SOURCE],
        }
    }

    #[test]
    fn a_frame_without_the_true_pose_of_the_ego_has_a_result_and_no_truth_in_the_files() {
        let folder = tempfile::tempdir().unwrap();
        let mut lines = FrameLines::create(folder.path()).unwrap();
        for (tick, pose) in [(0, Some(Pose::IDENTITY)), (1, None)] {
            assert!(lines.add(Some("s"), &frame(tick, pose)).is_continue());
        }
        let failed = EvaluatedFrame {
            failure: Some("no point".into()),
            ..frame(2, None)
        };
        assert!(lines.add(Some("s"), &failed).is_continue());
        lines.finish().unwrap();
        let ticks = ["detections.jsonl", "truth.jsonl"].map(|name| {
            let text = std::fs::read_to_string(folder.path().join(name)).unwrap();
            text.lines().count()
        });
        assert_eq!(ticks, [2, 1]);
    }

    #[test]
    fn a_frame_without_the_true_pose_of_the_ego_counts_in_no_score() {
        let mut scores = FrameScores::new(ego(), RULE, 1);
        for (tick, pose) in [Some(Pose::IDENTITY), None, Some(Pose::IDENTITY)]
            .into_iter()
            .enumerate()
        {
            judge(&mut scores, frame(tick, pose), true);
        }
        let ticks: Vec<u64> = scores.records().iter().map(|record| record.tick).collect();
        assert_eq!((ticks, scores.ticks()), (vec![0, 1, 2], (2, 2)));
        assert_eq!(scores.unplaced(), [1]);
    }
}
