use dataset::class_set::ClassSet;
use protocol::Box3d;
use protocol::{
    AgentTruth, Detection, FusedNeighbour, MisbehaviourReason, NeighbourState, SkippedNeighbour,
    TrueObject,
};

use super::super::open_ticks::MOST_OPEN;
use super::*;
use crate::score::metrics::tests::is_near;
use crate::score::metrics::{Communication, PoseErrors};

const RULE: GroundTruthRule = GroundTruthRule {
    x_m: [-50.0, 50.0],
    y_m: [-40.0, 40.0],
    z_m: [-3.0, 1.0],
    comm_range_m: 70.0,
    min_corners: 8,
    classes: ClassSet::VEHICLES,
};

fn cav(text: &str) -> CavId {
    CavId::new(text).unwrap()
}

fn stamp(name: &str, tick: u64, publish_ms: u64) -> Stamp {
    let publish_nanos = publish_ms * 1_000_000;
    Stamp {
        cav: cav(name),
        epoch: 1,
        sequence: tick,
        capture_nanos: tick * 100_000_000,
        publish_nanos,
    }
}

fn object(id: i64, class: &str, x: f64) -> TrueObject {
    let world_from_object = Pose::from_xyz_yaw([x, 0.0, -1.0], 0.0);
    TrueObject {
        id,
        class: class.into(),
        world_from_object,
        size_m: [4.0, 2.0, 1.5],
        speed_mps: None,
    }
}

fn agent(name: &str, x: f64, objects: Vec<TrueObject>) -> AgentTruth {
    AgentTruth {
        cav: cav(name),
        world_from_lidar: Pose::from_xyz_yaw([x, 0.0, 0.0], 0.0),
        objects,
    }
}

/// The ego at the origin sees 1 and a pedestrian, its neighbour at x = 20 m sees 1 and 2.
fn truth(tick: u64) -> Truth {
    let (first, second) = (object(1, "car", 10.0), object(2, "van", 30.0));
    Truth {
        tick,
        agents: vec![
            agent("e", 0.0, vec![first.clone(), object(9, "pedestrian", 5.0)]),
            agent("n", 20.0, vec![first, second]),
        ],
    }
}

fn result(tick: u64, at_x: &[f64]) -> Detections {
    let detections = at_x.iter().map(|&x| Detection {
        box3d: Box3d {
            center_m: [x, 0.0, -1.0],
            size_m: [4.0, 2.0, 1.5],
            heading_rad: 0.0,
        },
        score: 0.9,
        source: None,
    });
    Detections {
        ego: cav("e"),
        agent_frame: tick,
        method: "max".into(),
        pose: PoseEstimate::new(Pose::from_xyz_yaw([1.0, 0.0, 0.0], 0.0), 1.0),
        detections: detections.collect(),
        fused: vec![FusedNeighbour {
            cav: cav("n"),
            age_nanos: 0,
            confidence: 1.0,
            payload_bytes: 1000,
            wire_bytes: 1300,
        }],
        skipped: vec![],
        neighbours: vec![NeighbourState {
            cav: cav("n"),
            trust: Some(0.5 + 0.25 * tick as f64),
            misbehaviour: None,
            clock_offset_s: Some(0.125),
            capture_offset_s: Some(0.3),
        }],
        stages: vec![],
    }
}

fn scores() -> FrameScores {
    FrameScores::new(cav("e"), RULE, 64 * 96 * 128)
}

#[test]
fn a_frame_is_judged_against_everyones_truth() {
    let mut scores = scores();
    scores.truth(&stamp("replay", 0, 1_000), truth(0));
    scores.result(&stamp("e", 0, 1_080), result(0, &[10.0, 30.0, -20.0]));
    scores.close();
    let record = &scores.records()[0];
    assert_eq!(
        (record.truth, record.detected, record.found),
        (2, 3, 2),
        "the pedestrian does not count"
    );
    assert_eq!(
        (record.latency_ms, record.payload_bytes, record.wire_bytes),
        (Some(80.0), 1000, 1300)
    );
    assert_eq!(record.ego_error_m, Some(1.0));
    let [global, _] = scores.average_precision();
    assert_eq!(
        global.at_50,
        Some(1.0),
        "the false box has the same score and comes last"
    );
    assert_eq!(
        Communication::of(&scores.bytes, scores.nominal_values).payload_bytes_mean,
        Some(1000.0)
    );
    assert_eq!(scores.showpiece().unwrap().truth.len(), 2);
}

/// Scores of ten ticks, of which each result comes after its truth, or everything in the opposite order.
fn scores_of_ten_ticks(backwards: bool) -> FrameScores {
    let mut scores = scores();
    let mut ticks: Vec<u64> = (0..10).collect();
    if backwards {
        ticks.reverse();
    }
    for tick in ticks {
        let detected: &[f64] = if tick % 2 == 0 {
            &[10.0]
        } else {
            &[-7.0, 30.0]
        };
        if backwards {
            scores.result(&stamp("e", tick, 50), result(tick, detected));
            scores.truth(&stamp("replay", tick, 0), truth(tick));
        } else {
            scores.truth(&stamp("replay", tick, 0), truth(tick));
            scores.result(&stamp("e", tick, 50), result(tick, detected));
        }
    }
    scores.close();
    scores
}

#[test]
fn order_of_arrival_changes_nothing() {
    let [forwards, backwards] = [false, true].map(scores_of_ten_ticks);
    assert_eq!(forwards.average_precision(), backwards.average_precision());
    assert_eq!(forwards.records(), backwards.records());
}

#[test]
fn a_tick_without_result_is_missed_and_a_second_result_ignored() {
    let mut scores = scores();
    for tick in 0..3 {
        scores.truth(&stamp("replay", tick, 0), truth(tick));
    }
    scores.result(&stamp("e", 1, 50), result(1, &[10.0]));
    scores.result(&stamp("e", 1, 90), result(1, &[]));
    scores.close();
    assert_eq!((scores.missed(), scores.ticks()), (2, (3, 1)));
    let answered: Vec<bool> = scores
        .records()
        .iter()
        .map(FrameRecord::is_answered)
        .collect();
    assert_eq!(answered, [false, true, false], "every tick has a record");
    assert_eq!(
        (scores.records()[1].latency_ms, scores.records()[1].detected),
        (Some(50.0), 1)
    );
}

fn began_ms(tick: u64) -> u64 {
    1_000 + 100 * tick
}

/// Three precisions of hand-made ticks, 100 ms apart, with two cars that stand still in front of an ego that stands too:
/// tick 0 is answered in full after 50 ms, tick 1 not at all, tick 2 in full after 250 ms, tick 3 with one car.
#[test]
fn the_three_precisions_differ_in_what_they_count() {
    let mut scores = scores();
    for tick in 0..4 {
        scores.truth(&stamp("replay", tick, began_ms(tick)), truth(tick));
    }
    for (tick, latency_ms, at_x) in [
        (0, 50, &[10.0, 30.0][..]),
        (2, 250, &[10.0, 30.0]),
        (3, 20, &[10.0]),
    ] {
        scores.result(
            &stamp("e", tick, began_ms(tick) + latency_ms),
            result(tick, at_x),
        );
    }
    scores.close();
    // Five of the six boxes of the answered ticks, and five of the eight of all.
    assert!(is_near(scores.average_precision()[0].at_50, 5.0 / 6.0));
    assert!(is_near(scores.live.unanswered_empty().at_50, 5.0 / 8.0));
    // Nothing is published by tick 0; its result is the newest at the three that follow: 6 of 8 boxes.
    assert!(is_near(scores.live.streaming().unwrap().at_50, 6.0 / 8.0));
    let streamed: Vec<Option<u64>> = scores
        .records()
        .iter()
        .map(|record| Some(record.streamed?.tick))
        .collect();
    assert_eq!(streamed, [None, Some(0), Some(0), Some(0)]);
    assert_eq!(
        scores.records()[2]
            .streamed
            .map(|streamed| (streamed.age_ms, streamed.found)),
        Some((200.0, 2))
    );
    assert_eq!(scores.ticks(), (4, 3));
}

#[test]
fn the_first_tick_of_another_round_is_not_compared_with_the_boxes_of_the_last() {
    let mut scores = scores();
    // Another round begins more than a minute later on the scene's clock, and goes on at once.
    for (place, tick) in [(0, 0), (1, 1), (2, 700), (3, 701)] {
        let began_ms = began_ms(place);
        scores.truth(&stamp("replay", tick, began_ms), truth(tick));
        scores.result(&stamp("e", tick, began_ms + 50), result(tick, &[10.0]));
    }
    scores.close();
    let records = scores.records().iter();
    let streamed: Vec<bool> = records.map(|record| record.streamed.is_some()).collect();
    assert_eq!(streamed, [false, true, false, true]);
}

#[test]
fn a_tick_without_the_true_pose_of_the_ego_counts_in_no_score_and_its_result_has_a_record() {
    let [known, with_unknown] = [2, 5].map(|ticks| {
        let mut scores = scores();
        for tick in 0..ticks {
            let mut truth = truth(tick);
            // At tick 2 the neighbour alone has a pose, at tick 3 nobody.
            truth
                .agents
                .drain(..(tick as usize).saturating_sub(1).min(2));
            let began_ms = began_ms(tick);
            scores.truth(&stamp("replay", tick, began_ms), truth);
            // At tick 4 the ego takes no part.
            if tick < 4 {
                let result = result(tick, &[10.0, 20.0]);
                scores.result(&stamp("e", tick, began_ms + 50), result);
            }
        }
        scores.close();
        scores
    });
    assert_eq!([&known, &with_unknown].map(FrameScores::ticks), [(2, 2); 2]);
    assert_eq!(
        (with_unknown.missed(), with_unknown.records().len()),
        (0, 4)
    );
    assert_eq!(known.average_precision(), with_unknown.average_precision());
    let [before, after] = [&known, &with_unknown].map(|scores| scores.live.unanswered_empty());
    assert_eq!(before, after);
    let [before, after] = [&known, &with_unknown].map(|scores| scores.live.streaming());
    assert_eq!(before, after);
    assert_eq!(
        (known.unplaced(), with_unknown.unplaced()),
        (&[][..], &[2, 3, 4][..])
    );
    let last = &with_unknown.records()[3];
    assert_eq!((last.latency_ms, last.detected), (Some(50.0), 0));
    assert_eq!(with_unknown.showpiece().map(|frame| frame.tick), Some(0));
}

#[test]
fn where_nobody_has_a_true_pose_results_have_a_record_and_no_score() {
    let mut scores = scores();
    for tick in 0..2 {
        let agents = Vec::new();
        scores.truth(&stamp("replay", tick, 0), Truth { tick, agents });
        scores.result(&stamp("e", tick, 50), result(tick, &[10.0]));
    }
    scores.close();
    assert_eq!((scores.ticks(), scores.missed()), ((0, 0), 0));
    assert_eq!(
        (scores.records().len(), scores.unplaced()),
        (2, &[0, 1][..])
    );
}

#[test]
fn poses_of_all_vehicles_are_judged() {
    let mut scores = scores();
    scores.pose(
        &stamp("n", 0, 0),
        PoseEstimate::new(Pose::from_xyz_yaw([20.0, 4.0, 0.0], 0.0), 0.5),
    );
    let reason = protocol::NoPoseReason::TooFewPoints;
    scores.pose(
        &stamp("e", 0, 0),
        PoseEstimate::NoPose {
            reason,
            inlier_count: 2,
        },
    );
    scores.pose(
        &stamp("unknown", 0, 0),
        PoseEstimate::new(Pose::IDENTITY, 0.5),
    );
    scores.truth(&stamp("replay", 0, 0), truth(0));
    scores.close();
    let errors = PoseErrors::of(&scores.pose_errors, scores.no_pose);
    assert_eq!(
        (errors.mean_m, errors.no_pose, errors.success_3m),
        (Some(4.0), 1, Some(0.0))
    );
}

#[test]
fn an_older_tick_that_comes_late_is_closed_in_order() {
    let mut scores = scores();
    for tick in (0..1_000).filter(|tick| *tick != 700) {
        scores.truth(&stamp("replay", tick, 0), truth(tick));
        if tick == 900 {
            scores.truth(&stamp("replay", 700, 0), truth(700));
        }
    }
    scores.close();
    let ticks: Vec<u64> = scores.records().iter().map(|record| record.tick).collect();
    assert!(ticks.is_sorted(), "{ticks:?}");
}

#[test]
fn a_long_run_keeps_few_ticks_open() {
    let mut scores = scores();
    for tick in 0..1_000 {
        scores.truth(&stamp("replay", tick, 0), truth(tick));
        scores.result(&stamp("e", tick, 50), result(tick, &[10.0]));
    }
    assert!(scores.open.open.len() <= MOST_OPEN && scores.records().len() >= 1_000 - MOST_OPEN);
    scores.result(&stamp("e", 3, 50), result(3, &[]));
    scores.close();
    assert_eq!(
        scores.records().len(),
        1_000,
        "a late second result of a judged tick adds none"
    );
}

#[test]
fn neighbours_are_followed_over_the_run() {
    let mut scores = FrameScores::new(cav("e"), RULE, 1);
    let misbehaving = Detections {
        fused: vec![],
        skipped: vec![SkippedNeighbour {
            cav: cav("n"),
            reason: Some(DropReason::Misbehaviour),
        }],
        neighbours: vec![NeighbourState {
            cav: cav("n"),
            trust: Some(0.25),
            misbehaviour: Some(MisbehaviourReason::GhostObjects),
            clock_offset_s: None,
            capture_offset_s: None,
        }],
        ..result(1, &[])
    };
    for (tick, result) in [(0, result(0, &[])), (1, misbehaving)] {
        scores.truth(&stamp("replay", tick, 100 * tick), truth(tick));
        scores.result(&stamp("e", tick, 100 * tick + 50), result);
    }
    scores.close();
    let record = &scores.neighbours[&cav("n")];
    assert_eq!(
        (
            record.fused,
            record.left_out[&DropReason::Misbehaviour],
            record.misbehaviour_counts[&MisbehaviourReason::GhostObjects]
        ),
        (1, 1, 1)
    );
    assert_eq!((record.trust, record.least_trust), (Some(0.25), Some(0.25)));
    assert_eq!(
        (record.misbehaviour, record.clock_offset_s),
        (Some(MisbehaviourReason::GhostObjects), Some(0.125))
    );
}
