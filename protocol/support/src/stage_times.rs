//! Stage times: duration of each stage, in the order of the stages.

use std::time::{Duration, Instant};

use protocol::StageTiming;

/// Durations of consecutive stages; a stage that recurs has the sum of its times.
#[derive(Debug, Clone, PartialEq)]
pub struct StageTimes {
    last: Instant,
    timings: Vec<StageTiming>,
}

impl StageTimes {
    /// Starts the first stage now.
    pub fn start() -> Self {
        Self::of(&[])
    }

    /// Starts the first stage now; `stages` are reported in this order, also those that take no time.
    pub fn of(stages: &[&str]) -> Self {
        let stages = stages.iter();
        Self {
            last: Instant::now(),
            timings: (stages.map(|stage| StageTiming::new(stage, Duration::ZERO))).collect(),
        }
    }

    /// Ends a stage and starts the next one; returns the time since the last end.
    pub fn lap(&mut self, stage: &str) -> Duration {
        let now = Instant::now();
        let took = now - self.last;
        self.last = now;
        self.add(stage, took);
        took
    }

    /// Adds a time that was measured elsewhere to a stage.
    pub fn add(&mut self, stage: &str, took: Duration) {
        let timing = StageTiming::new(stage, took);
        match self.timings.iter_mut().find(|known| known.stage == stage) {
            Some(known) => known.nanos = known.nanos.saturating_add(timing.nanos),
            None => self.timings.push(timing),
        }
    }

    /// All stages so far.
    pub fn timings(&self) -> &[StageTiming] {
        &self.timings
    }

    /// All stages so far.
    pub fn into_timings(self) -> Vec<StageTiming> {
        self.timings
    }

    /// Sum of all stages.
    pub fn total(&self) -> Duration {
        Duration::from_nanos(self.timings.iter().map(|timing| timing.nanos).sum())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn laps_add_up_to_the_whole_time_and_keep_their_order() {
        let began = Instant::now();
        let mut times = StageTimes::start();
        std::thread::sleep(Duration::from_millis(2));
        let first = times.lap("first");
        let second = times.lap("second");
        assert!(first >= Duration::from_millis(2) && first + second <= began.elapsed());
        let again = times.lap("first");
        assert_eq!(times.total(), first + second + again);
        assert_eq!(
            times.into_timings(),
            [
                StageTiming::new("first", first + again),
                StageTiming::new("second", second)
            ]
        );
    }

    #[test]
    fn stages_that_take_no_time_are_reported() {
        let mut times = StageTimes::of(&["first", "second"]);
        let second = times.lap("second");
        let expected = [("first", Duration::ZERO), ("second", second)];
        assert_eq!(
            times.timings(),
            expected.map(|(stage, took)| StageTiming::new(stage, took))
        );
    }
}
