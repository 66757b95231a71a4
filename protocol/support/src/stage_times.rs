//! Stage times: duration of each stage, in the order of the stages.

use std::time::{Duration, Instant};

use protocol::StageTiming;

/// Durations of consecutive stages.
#[derive(Debug, Clone)]
pub struct StageTimes {
    last: Instant,
    timings: Vec<StageTiming>,
}

impl StageTimes {
    /// Starts the first stage now.
    #[must_use]
    pub fn start() -> Self {
        Self {
            last: Instant::now(),
            timings: Vec::new(),
        }
    }

    /// Ends a stage and starts the next one; returns its duration.
    pub fn lap(&mut self, stage: &str) -> Duration {
        let now = Instant::now();
        let took = now - self.last;
        self.timings.push(StageTiming::new(stage, took));
        self.last = now;
        took
    }

    /// All stages so far.
    #[must_use]
    pub fn into_timings(self) -> Vec<StageTiming> {
        self.timings
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
        let timings = times.into_timings();
        assert_eq!(
            timings,
            [
                StageTiming::new("first", first),
                StageTiming::new("second", second)
            ]
        );
    }
}
