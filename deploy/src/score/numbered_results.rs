//! Results with the tick of the scene, from the truth of the same capture time.

use std::collections::{BTreeMap, VecDeque};

use protocol::FrameReport;

/// Largest number of results that wait for their truth, and of ticks that are remembered.
const PLACES: usize = 256;

/// Results that wait to be written. They keep their order, and wait only while their truth may still arrive.
pub(super) struct NumberedResults<T> {
    /// Tick by capture time.
    ticks: BTreeMap<u64, u64>,
    waiting: VecDeque<FrameReport<T>>,
}

impl<T> Default for NumberedResults<T> {
    fn default() -> Self {
        Self {
            ticks: BTreeMap::new(),
            waiting: VecDeque::new(),
        }
    }
}

impl<T> NumberedResults<T> {
    /// Records the tick of a capture time.
    pub(super) fn tick(&mut self, capture_nanos: u64, tick: u64) {
        self.ticks.insert(capture_nanos, tick);
        if self.ticks.len() > PLACES {
            self.ticks.pop_first();
        }
    }

    /// Appends a result.
    pub(super) fn result(&mut self, report: FrameReport<T>) {
        self.waiting.push_back(report);
    }

    /// The next result whose tick is known, or will not be: a later truth has arrived, too many wait, or the run
    /// `is_over`.
    pub(super) fn next(&mut self, is_over: bool) -> Option<FrameReport<T>> {
        let capture_nanos = self.waiting.front()?.capture_nanos;
        let tick = self.ticks.get(&capture_nanos).copied();
        let newest = self.ticks.last_key_value();
        // Ticks are published in order, so behind a later truth an earlier one is lost.
        let is_past = newest.is_some_and(|(newest, _)| *newest > capture_nanos);
        if tick.is_none() && !is_past && !is_over && self.waiting.len() <= PLACES {
            return None;
        }
        let report = self.waiting.pop_front()?;
        Some(FrameReport { tick, ..report })
    }
}

#[cfg(test)]
mod tests {
    use protocol::{CavId, Detections, Pose, PoseEstimate, Stamp};

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

    fn ticks(results: &mut NumberedResults<Detections>, is_over: bool) -> Vec<(u64, Option<u64>)> {
        std::iter::from_fn(|| results.next(is_over))
            .map(|report| (report.capture_nanos, report.tick))
            .collect()
    }

    #[test]
    fn results_carry_the_tick_of_their_capture_time_whichever_comes_first() {
        let mut results = NumberedResults::default();
        results.tick(100, 7);
        results.result(report(100));
        results.result(report(200));
        assert_eq!(ticks(&mut results, false), [(100, Some(7))]);
        results.tick(200, 8);
        results.tick(300, 9);
        assert_eq!(ticks(&mut results, false), [(200, Some(8))]);
    }

    #[test]
    fn a_lost_truth_delays_no_other_result() {
        let mut results = NumberedResults::default();
        results.result(report(100));
        results.result(report(200));
        assert_eq!(ticks(&mut results, false), []);
        results.tick(200, 8);
        assert_eq!(ticks(&mut results, false), [(100, None), (200, Some(8))]);
        results.result(report(300));
        assert_eq!(ticks(&mut results, true), [(300, None)]);
        (0..=PLACES as u64).for_each(|k| results.result(report(400 + k)));
        assert_eq!(ticks(&mut results, false), [(400, None)]);
    }
}
