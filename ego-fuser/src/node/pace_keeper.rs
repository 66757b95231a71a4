//! Pace keeper: publishes the pace of an ego to the agents.

use std::time::{Duration, Instant};

use bus::{Bus, BusError, Publisher, PublisherOptions};
use protocol::{CavId, Pace, Stream, Topic};

use crate::pace_control::PaceControl;

/// Period at which the pace is repeated: for agents that join late, and so that a slower ego of the fleet does not set
/// the pace of one that keeps up.
const REPEAT_PERIOD: Duration = Duration::from_secs(1);

/// Controller of the pace, and its publisher.
pub(super) struct PaceKeeper {
    /// None where every sweep is computed in any case.
    control: Option<PaceControl>,
    publisher: Publisher,
    pace: Pace,
    published: Instant,
}

impl PaceKeeper {
    pub(super) fn open(bus: &Bus, cav: &CavId, is_controlled: bool) -> Result<Self, BusError> {
        let topic = Topic::Stream {
            cav: cav.clone(),
            stream: Stream::Pace,
        };
        let now = Instant::now();
        Ok(Self {
            control: is_controlled.then(|| PaceControl::new(now)),
            publisher: bus.publisher(topic, PublisherOptions::POSE)?,
            pace: Pace::EVERY_SWEEP,
            published: now,
        })
    }

    /// Judges a frame of the own agent that has waited for another one.
    pub(super) fn judge(&mut self, capture_nanos: u64, waited: Duration) {
        let now = Instant::now();
        let judged = self.control.as_mut();
        let Some(pace) = judged.and_then(|control| control.judge(capture_nanos, waited, now))
        else {
            return;
        };
        let Pace { computed, of, .. } = pace;
        tracing::info!(
            capture_nanos,
            "the pace of the fleet changes to {computed} of {of} sweeps"
        );
        self.publish(pace);
    }

    /// Publishes the pace again, if it is time for that.
    pub(super) fn repeat(&mut self) {
        if self.published.elapsed() >= REPEAT_PERIOD {
            self.publish(self.pace);
        }
    }

    fn publish(&mut self, pace: Pace) {
        self.pace = pace;
        self.published = Instant::now();
        self.publisher.submit(0, pace);
    }

    pub(super) fn finish(self) {
        self.publisher.finish();
    }
}
