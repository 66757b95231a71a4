//! Average precision over all ticks of a live run: ticks without a result count, and so does the age of a result.

use std::collections::VecDeque;

use perception::boxes::postprocess::is_within;
use protocol::{Box3d, Detection, Pose};
use training::average_precision::{Ordering, Scorer};

use crate::score::metrics::{Answered, ByIou};

/// Largest number of detections that were published after the ticks scored so far: more than any run has in flight.
const MOST_KEPT: usize = 64;

/// Precision over all ticks so far. Ticks come in the order of their capture times.
#[derive(Default)]
pub(super) struct LivePrecision {
    answered: u64,
    ticks: u64,
    all_ticks: Scorer,
    streaming: Scorer,
    published: VecDeque<Published>,
}

/// Detections, their time of publication and the ego's pose at their capture.
struct Published {
    nanos: u64,
    world_from_ego: Option<Pose>,
    detections: Vec<Detection>,
}

/// Ground truth of a tick.
pub(super) struct TickTruth<'a> {
    /// Time of publication of the tick, nanoseconds.
    pub(super) began_nanos: u64,
    /// True pose of the ego's LiDAR.
    pub(super) world_from_ego: Option<Pose>,
    /// True boxes in the ego's LiDAR frame.
    pub(super) boxes: &'a [Box3d],
    /// Area of the scored boxes: x, y of the lower, then of the upper corner, metres in that frame.
    pub(super) area_m: [f64; 4],
}

impl LivePrecision {
    /// Adds a tick; `answer` holds its detections and their time of publication, nanoseconds, or `None`.
    pub(super) fn add(&mut self, truth: &TickTruth<'_>, answer: Option<(u64, &[Detection])>) {
        self.ticks += 1;
        self.answered += u64::from(answer.is_some());
        self.all_ticks.add(answer.map_or(&[], |(_, detections)| detections), truth.boxes);
        let known = self.newest(truth);
        self.streaming.add(&known, truth.boxes);
        if let Some((nanos, detections)) = answer {
            let (world_from_ego, detections) = (truth.world_from_ego, detections.to_vec());
            self.published.push_back(Published { nanos, world_from_ego, detections });
            if self.published.len() > MOST_KEPT {
                self.published.pop_front();
            }
        }
    }

    /// Another scenario begins: detections of the previous one do not apply to it.
    pub(super) fn forget(&mut self) {
        self.published.clear();
    }

    /// The precision; `None` without ticks.
    pub(super) fn answered(&self) -> Option<Answered> {
        (self.ticks > 0).then(|| Answered {
            answered: self.answered,
            ticks: self.ticks,
            ap_all_ticks: by_iou(&self.all_ticks, Ordering::Global),
            streaming_ap: by_iou(&self.streaming, Ordering::Global),
        })
    }

    /// The detections of the newest sweep that were published by a tick, moved to the ego's pose at that tick. Older
    /// ones are dropped.
    fn newest(&mut self, truth: &TickTruth<'_>) -> Vec<Detection> {
        let Some(index) = self.published.iter().rposition(|published| published.nanos <= truth.began_nanos) else {
            return Vec::new();
        };
        self.published.drain(..index);
        let Some(Published { world_from_ego, detections, .. }) = self.published.front() else { return Vec::new() };
        let now_from_then = match (truth.world_from_ego, world_from_ego) {
            (Some(now), Some(then)) => now.from_world(then).isometry(),
            _ => Pose::IDENTITY.isometry(),
        };
        let moved = detections.iter().map(|found| {
            let box3d = found.box3d.transformed(&now_from_then);
            Detection { box3d, ..found.clone() }
        });
        moved.filter(|found| is_within(&found.box3d.corners(), truth.area_m)).collect()
    }
}

/// AP at the three IoU thresholds; `None` without a true object.
pub(super) fn by_iou(scorer: &Scorer, ordering: Ordering) -> ByIou {
    let objects = scorer.tallies().first().map_or(0, |tally| tally.objects);
    match scorer.average_precisions(ordering)[..] {
        [at_30, at_50, at_70] if objects > 0 => ByIou { at_30: Some(at_30), at_50: Some(at_50), at_70: Some(at_70) },
        _ => ByIou::default(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const AREA_M: [f64; 4] = [-50.0, -40.0, 50.0, 40.0];

    fn car(x: f64) -> Box3d {
        Box3d { center_m: [x, 0.0, -1.0], size_m: [4.0, 2.0, 1.5], heading_rad: 0.0 }
    }

    /// The ego drives 1 m along x from tick to tick, ten a second, towards a car that stands at 20 m in the world; the
    /// ticks in `answered` have results that contain it, with the given latency.
    fn run(ticks: u64, answered: &[u64], latency_ms: u64, speed_m: f64) -> Answered {
        let mut live = LivePrecision::default();
        for tick in 0..ticks {
            let began_nanos = 1_000_000_000 + tick * 100_000_000;
            let ego_x = tick as f64;
            let boxes = [car(20.0 + speed_m * tick as f64 - ego_x)];
            let world_from_ego = Some(Pose::from_xyz_yaw([ego_x, 0.0, 0.0], 0.0));
            let found = [Detection { box3d: boxes[0], score: 0.9, source: None }];
            let answer = answered.contains(&tick).then_some((began_nanos + latency_ms * 1_000_000, &found[..]));
            live.add(&TickTruth { began_nanos, world_from_ego, boxes: &boxes, area_m: AREA_M }, answer);
        }
        live.answered().unwrap()
    }

    #[test]
    fn an_unanswered_tick_is_a_frame_without_detections() {
        let score = run(4, &[0, 2, 3], 50, 0.0);
        assert_eq!((score.answered, score.ticks), (3, 4));
        assert_eq!(score.ap_all_ticks.at_50, Some(0.75));
    }

    #[test]
    fn the_last_answer_serves_until_the_next_and_the_egos_own_motion_does_not_spoil_it() {
        // Nothing is published by the first tick; its result serves the three that follow.
        assert_eq!(run(4, &[0], 50, 0.0).streaming_ap.at_70, Some(0.75));
        // A result that takes 250 ms serves from the third tick after its own on.
        assert_eq!(run(4, &[0, 1, 2, 3], 250, 0.0).streaming_ap.at_70, Some(0.25));
    }

    #[test]
    fn what_moves_is_no_longer_where_it_was_found() {
        // 0.5 m a tick and results that are one tick old: an overlap of 0.78. Two ticks old: 0.6.
        let is_near = |found: Option<f64>, expected: f64| (found.unwrap() - expected).abs() < 1e-9;
        assert!(is_near(run(5, &[0, 1, 2, 3, 4], 100, 0.5).streaming_ap.at_70, 0.8));
        let late = run(5, &[0, 1, 2, 3, 4], 200, 0.5).streaming_ap;
        assert!(is_near(late.at_50, 0.6) && is_near(late.at_70, 0.0), "{late:?}");
    }

    #[test]
    fn boxes_that_the_ego_has_passed_are_not_judged() {
        let mut live = LivePrecision::default();
        let found = [Detection { box3d: car(-48.0), score: 0.9, source: None }];
        for (tick, boxes) in [vec![car(-48.0)], vec![car(10.0)]].iter().enumerate() {
            let began_nanos = 1_000 * tick as u64;
            let world_from_ego = Some(Pose::from_xyz_yaw([5.0 * tick as f64, 0.0, 0.0], 0.0));
            let answer = (tick == 0).then_some((began_nanos, &found[..]));
            live.add(&TickTruth { began_nanos, world_from_ego, boxes, area_m: AREA_M }, answer);
        }
        assert_eq!(live.streaming.tallies()[0].matched, [], "it is behind the area at the second tick");
        live.forget();
        assert_eq!((live.published.len(), live.ticks), (0, 2));
        assert!(LivePrecision::default().answered().is_none());
    }
}
