//! Replay clock: wall-clock time at which the next tick is due.

use std::time::{Duration, Instant};

/// Slowest rate, close to a halt: the time to the next tick must be representable.
const SLOWEST: f64 = 1e-6;

/// Mapping from scene time to the wall clock: running at a rate, or halted, possibly with some ticks still to be
/// published.
#[derive(Debug, Clone)]
pub(crate) struct ReplayClock {
    /// Seconds of the scene per second of the wall clock; 0: every tick is due at once.
    rate: f64,
    /// Ticks that may still be published while it is halted; `None`: it runs.
    steps: Option<u64>,
    // Wall-clock time at which a capture time was due; all others follow from it. `None`: the next tick is due at once.
    anchor: Option<(Instant, u64)>,
}

impl ReplayClock {
    /// A running clock.
    pub(crate) fn new(rate: f64) -> Self {
        Self {
            rate,
            steps: None,
            anchor: None,
        }
    }

    /// Runs on from here, at another rate if one is given.
    pub(crate) fn resume(&mut self, rate: Option<f64>) {
        *self = Self::new(rate.unwrap_or(self.rate));
    }

    /// Halts after the current tick.
    pub(crate) fn pause(&mut self) {
        self.steps = Some(0);
    }

    /// True if it is halted, with no further ticks to be published.
    pub(super) fn is_halted(&self) -> bool {
        self.steps == Some(0)
    }

    /// Halts, but allows `ticks` more, each at once.
    pub(crate) fn step(&mut self, ticks: u64) {
        // Steps that are asked for in quick succession add up.
        self.steps = Some(self.steps.unwrap_or(0).saturating_add(ticks));
    }

    /// After a jump of the scene's time, or a wait: the next tick is due at once.
    pub(crate) fn rebase(&mut self) {
        self.anchor = None;
    }

    /// Time at which the tick captured at `capture_nanos` is due; `None` while the clock is halted.
    pub(crate) fn due(&self, capture_nanos: u64, now: Instant) -> Option<Instant> {
        match (self.steps, self.anchor) {
            (Some(0), _) => None,
            (None, Some((at, anchored))) if self.rate > 0.0 => {
                let scene = Duration::from_nanos(capture_nanos.saturating_sub(anchored));
                Some(at + scene.div_f64(self.rate.max(SLOWEST)))
            }
            _ => Some(now),
        }
    }

    /// Records that the tick captured at `capture_nanos`, which was due at `due`, was published. Counting from the due
    /// time and not from now keeps the pace: a late tick does not delay those after it.
    pub(crate) fn published(&mut self, capture_nanos: u64, due: Instant) {
        match &mut self.steps {
            None => self.anchor = Some((due, capture_nanos)),
            Some(steps) => *steps = steps.saturating_sub(1),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const TENTH: u64 = 100_000_000;

    #[test]
    fn ticks_keep_the_pace_however_late_one_was() {
        let mut clock = ReplayClock::new(2.0);
        let start = Instant::now();
        assert_eq!(clock.due(5 * TENTH, start), Some(start));
        clock.published(5 * TENTH, start);
        for tick in 1..5 {
            let due = clock
                .due((5 + tick) * TENTH, start + Duration::from_secs(9))
                .unwrap();
            assert_eq!(due, start + Duration::from_millis(50 * tick));
            clock.published((5 + tick) * TENTH, due);
        }
    }

    #[test]
    fn a_halted_clock_lets_steps_through() {
        let mut clock = ReplayClock::new(1.0);
        let now = Instant::now();
        clock.pause();
        assert_eq!(clock.due(0, now), None);
        clock.step(2);
        for tick in 0..2 {
            assert_eq!(clock.due(tick * TENTH, now), Some(now));
            clock.published(tick * TENTH, now);
        }
        assert_eq!(clock.due(2 * TENTH, now), None);
        clock.resume(None);
        assert_eq!(
            clock.due(2 * TENTH, now),
            Some(now),
            "the pause does not count as lateness"
        );
    }

    #[test]
    fn a_rate_next_to_nought_waits_long() {
        for rate in [1e-5, 1e-20, 1e-300, f64::MIN_POSITIVE] {
            let (mut clock, now) = (ReplayClock::new(rate), Instant::now());
            clock.published(0, now);
            assert!(clock.due(TENTH, now).unwrap() > now + Duration::from_secs(3600));
            assert!(clock.due(u64::MAX, now).is_some());
        }
    }

    #[test]
    fn rate_nought_waits_for_nothing() {
        let mut clock = ReplayClock::new(0.0);
        let now = Instant::now();
        clock.published(0, now);
        assert_eq!(clock.due(TENTH, now), Some(now));
        clock.resume(Some(1.0));
        clock.published(0, now);
        assert_eq!(
            clock.due(TENTH, now),
            Some(now + Duration::from_millis(100))
        );
    }
}
