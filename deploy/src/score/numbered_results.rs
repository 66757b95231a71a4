//! Results with the tick of the scene, from the truth of the same capture time.

use std::collections::{BTreeMap, BTreeSet, VecDeque};

use protocol::{FrameReport, Topic};

/// Largest number of results that wait for their truth.
const PLACES: usize = 256;

/// A recent tick of the scene.
pub(super) struct RecentTick {
    /// Its number, counted from 0.
    pub(super) tick: u64,
    /// Time of its publication, Unix nanoseconds.
    pub(super) publish_nanos: u64,
}

/// Capture times and topics of the last messages: a restarted replay plays its last tick once more, and the ego answers
/// it once more.
#[derive(Default)]
pub(super) struct RecentMessages(BTreeSet<(u64, Topic)>);

impl RecentMessages {
    /// Adds a message; true if it is the first of its topic and capture time.
    pub(super) fn is_first(&mut self, topic: &Topic, capture_nanos: u64) -> bool {
        let is_first = self.0.insert((capture_nanos, topic.clone()));
        if self.0.len() > PLACES {
            self.0.pop_first();
        }
        is_first
    }
}

/// The next of the results that wait to be written whose tick is known, or will not be: a later truth has arrived, too
/// many wait, or the run `is_over`. They keep their order, and wait only while their truth may still arrive; `ticks` are
/// by capture time.
pub(super) fn numbered<T>(
    waiting: &mut VecDeque<FrameReport<T>>,
    ticks: &BTreeMap<u64, RecentTick>,
    is_over: bool,
) -> Option<FrameReport<T>> {
    let capture_nanos = waiting.front()?.capture_nanos;
    let tick = ticks.get(&capture_nanos).map(|known| known.tick);
    let newest = ticks.last_key_value();
    // Ticks are published in order, so behind a later truth an earlier one is lost.
    let is_past = newest.is_some_and(|(newest, _)| *newest > capture_nanos);
    if tick.is_none() && !is_past && !is_over && waiting.len() <= PLACES {
        return None;
    }
    let report = waiting.pop_front()?;
    Some(FrameReport { tick, ..report })
}

#[cfg(test)]
mod tests {
    use protocol::{CavId, Detections, Pose, PoseEstimate, Stamp, Stream};

    use super::*;

    fn report(capture_nanos: u64) -> FrameReport<Detections> {
        let ego = CavId::new("e").unwrap();
        let stamp = Stamp {
            cav: ego.clone(),
            epoch: 1,
            sequence: 0,
            capture_nanos,
            publish_nanos: 0,
        };
        let pose = PoseEstimate::new(Pose::IDENTITY, 1.0);
        let (agent_frame, method) = (0, "max".to_owned());
        let (detections, fused, skipped, neighbours, stages) = Default::default();
        let result = Detections {
            ego,
            agent_frame,
            method,
            pose,
            detections,
            fused,
            skipped,
            neighbours,
            stages,
        };
        FrameReport::new(&stamp, None, result)
    }

    /// Results that wait, and the ticks that are known.
    #[derive(Default)]
    struct Results {
        waiting: VecDeque<FrameReport<Detections>>,
        known: BTreeMap<u64, RecentTick>,
    }

    impl Results {
        fn tick(&mut self, capture_nanos: u64, tick: u64) {
            let publish_nanos = 0;
            let known = RecentTick {
                tick,
                publish_nanos,
            };
            self.known.insert(capture_nanos, known);
        }

        fn result(&mut self, capture_nanos: u64) {
            self.waiting.push_back(report(capture_nanos));
        }

        fn ticks(&mut self, is_over: bool) -> Vec<(u64, Option<u64>)> {
            std::iter::from_fn(|| numbered(&mut self.waiting, &self.known, is_over))
                .map(|report| (report.capture_nanos, report.tick))
                .collect()
        }
    }

    #[test]
    fn results_carry_the_tick_of_their_capture_time_whichever_comes_first() {
        let mut results = Results::default();
        results.tick(100, 7);
        results.result(100);
        results.result(200);
        assert_eq!(results.ticks(false), [(100, Some(7))]);
        results.tick(200, 8);
        results.tick(300, 9);
        assert_eq!(results.ticks(false), [(200, Some(8))]);
    }

    #[test]
    fn a_message_that_is_repeated_is_not_the_first_of_its_capture_time() {
        let mut recent = RecentMessages::default();
        let detections = Topic::stream(&CavId::new("e").unwrap(), Stream::Detections);
        let mut are_first =
            |nanos| [&Topic::Truth, &detections].map(|topic| recent.is_first(topic, nanos));
        let captures = [300, 400, 400, 500, 300];
        assert_eq!(
            captures.map(&mut are_first),
            [true, true, false, true, false].map(|is_first| [is_first; 2])
        );
        (0..1_000).for_each(|nanos| _ = are_first(1_000 + nanos));
        assert_eq!(recent.0.len(), PLACES, "a long run keeps few");
    }

    #[test]
    fn a_lost_truth_delays_no_other_result() {
        let mut results = Results::default();
        results.result(100);
        results.result(200);
        assert_eq!(results.ticks(false), []);
        results.tick(200, 8);
        assert_eq!(results.ticks(false), [(100, None), (200, Some(8))]);
        results.result(300);
        assert_eq!(results.ticks(true), [(300, None)]);
        (0..=PLACES as u64).for_each(|k| results.result(400 + k));
        assert_eq!(results.ticks(false), [(400, None)]);
    }
}
