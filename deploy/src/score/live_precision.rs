//! Average precision over all ticks of a run: ticks without a result count, and so does the age of a result.

use std::collections::VecDeque;

use dataset::average_precision::{Ordering, Scorer};
use dataset::ground_truth::GroundTruth;
use protocol::{Detection, Pose};

use super::frame_record::StreamedResult;
use super::precision::{FrameCounts, by_iou};
use crate::score::metrics::ByIou;

/// Largest number of detections that were published after the ticks scored so far: more than any run has in flight.
const MOST_KEPT: usize = 64;

/// Precision over all ticks so far. Ticks come in the order of their capture times.
#[derive(Default)]
pub(super) struct LivePrecision {
    answered: u64,
    ticks: u64,
    all_ticks: Scorer,
    streaming: Scorer,
    published: VecDeque<PublishedAnswer>,
    /// True if a result has no time of publication.
    is_untimed: bool,
}

/// Detections, their time of publication, and the tick of their capture.
struct PublishedAnswer {
    nanos: u64,
    tick: EgoTick,
    detections: Vec<Detection>,
}

/// A tick and the ego at it.
#[derive(Clone, Copy)]
pub(super) struct EgoTick {
    /// Tick of the scene.
    pub(super) number: u64,
    /// Time of publication of the tick, nanoseconds.
    pub(super) began_nanos: u64,
    /// True pose of the ego's LiDAR.
    pub(super) world_from_ego: Pose,
}

impl LivePrecision {
    /// Adds a tick, the objects in the ego's LiDAR frame at it, and its detections, if there are some, in that frame at
    /// the capture, with their time of publication, nanoseconds, `None` without a clock; returns the detections that
    /// were newest at that time, with their score.
    pub(super) fn add(
        &mut self,
        tick: EgoTick,
        truth: &GroundTruth,
        detections: Option<&[Detection]>,
        published_nanos: Option<u64>,
    ) -> Option<StreamedResult> {
        self.ticks += 1;
        self.answered += u64::from(detections.is_some());
        self.all_ticks.add(detections.unwrap_or_default(), truth);
        // Before the result of this tick is added: it is published after the tick.
        let known = self.newest(&tick);
        let moved = known.as_ref().map_or(&[][..], |(.., moved)| moved);
        let FrameCounts { detected, found } = FrameCounts::of(&mut self.streaming, moved, truth);
        let streamed = known.map(|(tick, age_ms, _)| StreamedResult {
            tick,
            age_ms,
            detected,
            found,
        });
        let Some(detections) = detections else {
            return streamed;
        };
        let Some(nanos) = published_nanos else {
            self.is_untimed = true;
            return streamed;
        };
        self.published.push_back(PublishedAnswer {
            nanos,
            tick,
            detections: detections.to_vec(),
        });
        if self.published.len() > MOST_KEPT {
            self.published.pop_front();
        }
        streamed
    }

    /// Another scenario begins: detections of the previous one do not apply to it.
    pub(super) fn forget(&mut self) {
        self.published.clear();
    }

    /// Number of ticks so far, and of those with a result.
    pub(super) fn ticks(&self) -> (u64, u64) {
        (self.ticks, self.answered)
    }

    /// Average precision ordered by score; a tick without a result is a frame without detections.
    pub(super) fn unanswered_empty(&self) -> ByIou {
        by_iou(&self.all_ticks.tallies, Ordering::Global)
    }

    /// Streaming average precision, ordered by score; `None` if results have no time of publication.
    pub(super) fn streaming(&self) -> Option<ByIou> {
        let is_timed = self.ticks > 0 && !self.is_untimed;
        is_timed.then(|| by_iou(&self.streaming.tallies, Ordering::Global))
    }

    /// The detections of the newest sweep that were published by a tick, moved to the ego's pose at that tick, behind
    /// their own tick and their age in ms. Older ones are dropped.
    fn newest(&mut self, tick: &EgoTick) -> Option<(u64, f64, Vec<Detection>)> {
        let mut published = self.published.iter();
        let index = published.rposition(|published| published.nanos <= tick.began_nanos)?;
        self.published.drain(..index);
        let newest = self.published.front()?;
        let then = &newest.tick.world_from_ego;
        let now_from_then = tick.world_from_ego.from_world(then).isometry();
        let moved = newest.detections.iter().map(|found| Detection {
            box3d: found.box3d.transformed(&now_from_then),
            ..found.clone()
        });
        let age_nanos = tick.began_nanos.saturating_sub(newest.tick.began_nanos);
        Some((newest.tick.number, age_nanos as f64 * 1e-6, moved.collect()))
    }
}

#[cfg(test)]
mod tests {
    use protocol::Box3d;

    use super::*;
    use crate::score::metrics::tests::is_near;

    /// A car at `x` metres, in an area of 50 by 40 m.
    fn truth_at(x: f64) -> GroundTruth {
        GroundTruth {
            area_m: [-50.0, -40.0, 50.0, 40.0],
            ..GroundTruth::of_boxes([car(x)])
        }
    }

    fn car(x: f64) -> Box3d {
        Box3d {
            center_m: [x, 0.0, -1.0],
            size_m: [4.0, 2.0, 1.5],
            heading_rad: 0.0,
        }
    }

    /// The ego drives 1 m along x from tick to tick, ten a second, towards a car that stands at 20 m in the world; the
    /// ticks in `answered` have results that contain it, with the given latency.
    fn run(
        ticks: u64,
        answered: &[u64],
        latency_ms: u64,
        speed_m: f64,
    ) -> (LivePrecision, Vec<Option<StreamedResult>>) {
        let mut live = LivePrecision::default();
        let streamed = (0..ticks).map(|tick| {
            let began_nanos = 1_000_000_000 + tick * 100_000_000;
            let ego_x = tick as f64;
            let truth = truth_at(20.0 + speed_m * tick as f64 - ego_x);
            let world_from_ego = Pose::from_xyz_yaw([ego_x, 0.0, 0.0], 0.0);
            let found = [Detection {
                box3d: truth.objects[0].box3d,
                score: 0.9,
                source: None,
            }];
            let published_nanos = Some(began_nanos + latency_ms * 1_000_000);
            let detections = answered.contains(&tick).then_some(&found[..]);
            let tick = EgoTick {
                number: tick,
                began_nanos,
                world_from_ego,
            };
            live.add(tick, &truth, detections, published_nanos)
        });
        let streamed = streamed.collect();
        (live, streamed)
    }

    fn streaming(ticks: u64, answered: &[u64], latency_ms: u64, speed_m: f64) -> ByIou {
        run(ticks, answered, latency_ms, speed_m)
            .0
            .streaming()
            .unwrap()
    }

    #[test]
    fn an_unanswered_tick_is_a_frame_without_detections() {
        let (live, _) = run(4, &[0, 2, 3], 50, 0.0);
        assert_eq!(live.ticks(), (4, 3));
        assert_eq!(live.unanswered_empty().at_50, Some(0.75));
    }

    #[test]
    fn the_last_answer_serves_until_the_next_and_the_egos_own_motion_does_not_spoil_it() {
        // Nothing is published by the first tick; its result serves the three that follow.
        assert_eq!(streaming(4, &[0], 50, 0.0).at_70, Some(0.75));
        // A result that takes 250 ms serves from the third tick after its own on.
        assert_eq!(streaming(4, &[0, 1, 2, 3], 250, 0.0).at_70, Some(0.25));
    }

    #[test]
    fn each_tick_names_the_result_that_it_was_scored_with() {
        let (_, streamed) = run(4, &[0, 2], 150, 0.0);
        let expected = [None, None, Some(200.0), Some(300.0)].map(|age_ms| {
            Some(StreamedResult {
                tick: 0,
                age_ms: age_ms?,
                detected: 1,
                found: 1,
            })
        });
        assert_eq!(streamed, expected);
    }

    #[test]
    fn what_moves_is_no_longer_where_it_was_found() {
        // 0.5 m a tick and results that are one tick old: an overlap of 0.78. Two ticks old: 0.6.
        assert!(is_near(streaming(5, &[0, 1, 2, 3, 4], 100, 0.5).at_70, 0.8));
        let late = streaming(5, &[0, 1, 2, 3, 4], 200, 0.5);
        assert!(
            is_near(late.at_50, 0.6) && is_near(late.at_70, 0.0),
            "{late:?}"
        );
    }

    #[test]
    fn boxes_that_the_ego_has_passed_are_not_judged() {
        let mut live = LivePrecision::default();
        let found = [Detection {
            box3d: car(-48.0),
            score: 0.9,
            source: None,
        }];
        for (tick, truth) in (0..).zip(&[truth_at(-48.0), truth_at(10.0)]) {
            let began_nanos = 1_000 * tick;
            let world_from_ego = Pose::from_xyz_yaw([5.0 * tick as f64, 0.0, 0.0], 0.0);
            let detections = (tick == 0).then_some(&found[..]);
            let tick = EgoTick {
                number: tick,
                began_nanos,
                world_from_ego,
            };
            live.add(tick, truth, detections, Some(began_nanos));
        }
        assert_eq!(
            live.streaming.tallies[0].matched,
            [],
            "it is behind the area at the second tick"
        );
        live.forget();
        assert_eq!((live.published.len(), live.ticks), (0, 2));
        assert!(LivePrecision::default().streaming().is_none());
    }

    #[test]
    fn results_without_a_time_have_no_streaming_precision() {
        let mut live = LivePrecision::default();
        let truth = truth_at(10.0);
        let found = [Detection {
            box3d: car(10.0),
            score: 0.9,
            source: None,
        }];
        let tick = EgoTick {
            number: 0,
            began_nanos: 0,
            world_from_ego: Pose::IDENTITY,
        };
        live.add(tick, &truth, Some(&found), None);
        assert_eq!(
            (live.streaming(), live.unanswered_empty().at_70),
            (None, Some(1.0))
        );
    }
}
