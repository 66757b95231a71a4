//! Where the time of a frame goes.

use std::time::Instant;

use protocol::StageTiming;

/// Times of the stages, lap by lap.
pub(super) struct Stages {
    last: Instant,
    pub(super) timings: Vec<StageTiming>,
}

impl Stages {
    pub(super) fn start() -> Self {
        Self { last: Instant::now(), timings: Vec::new() }
    }

    pub(super) fn lap(&mut self, stage: &str) {
        let now = Instant::now();
        self.timings.push(StageTiming::new(stage, now - self.last));
        self.last = now;
    }
}
