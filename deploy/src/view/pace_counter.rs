//! Pace of a run as shown on the page: answered ticks and detections per second.

use std::collections::VecDeque;

use serde::Serialize;

/// Number of the last detections over which the rate is taken.
const RECENT: usize = 21;

/// Pace so far.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize)]
pub struct ShownPace {
    /// Number of ticks.
    pub ticks: u64,
    /// Number of ticks with detections.
    pub answered: u64,
    /// Detections per second, lately; `None` before the second one.
    pub rate_hz: Option<f64>,
}

/// Counts ticks and detections.
#[derive(Debug, Clone, Default)]
pub(super) struct PaceCounter {
    counts: ShownPace,
    /// Times of publication of the last detections, nanoseconds.
    published: VecDeque<u64>,
}

impl PaceCounter {
    /// Counts a tick; `published_nanos` is the time of publication of its detections, `None` without detections.
    pub(super) fn tick(&mut self, published_nanos: Option<u64>) {
        self.counts.ticks += 1;
        let Some(nanos) = published_nanos else { return };
        self.counts.answered += 1;
        self.published.push_back(nanos);
        if self.published.len() > RECENT {
            self.published.pop_front();
        }
    }

    pub(super) fn pace(&self) -> ShownPace {
        let ends = self.published.front().zip(self.published.back());
        let seconds = ends.map_or(0, |(first, last)| last.saturating_sub(*first)) as f64 * 1e-9;
        let rate_hz = (seconds > 0.0).then(|| (self.published.len() - 1) as f64 / seconds);
        ShownPace {
            rate_hz,
            ..self.counts
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_rate_is_that_of_the_last_detections() {
        let mut counter = PaceCounter::default();
        assert_eq!(counter.pace(), ShownPace::default());
        // Every second tick of ten a second is answered, later every one.
        (0..60).for_each(|tick| counter.tick((tick % 2 == 0).then_some(tick * 100_000_000)));
        let pace = counter.pace();
        assert_eq!((pace.ticks, pace.answered), (60, 30));
        assert!((pace.rate_hz.unwrap() - 5.0).abs() < 1e-9, "{pace:?}");
        (60..120).for_each(|tick| counter.tick(Some(tick * 100_000_000)));
        assert!((counter.pace().rate_hz.unwrap() - 10.0).abs() < 1e-9);
    }
}
