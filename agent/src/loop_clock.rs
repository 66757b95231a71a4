//! Loop clock: the time that a live process gives its loop.

use std::time::{Duration, Instant};

use bus::unix_nanos;
use support::nanos;

/// Clock of a loop: the Unix time of its beginning and the time since then. It is never set back.
#[derive(Debug, Clone, Copy)]
pub struct LoopClock {
    began: Instant,
    began_nanos: u64,
}

impl LoopClock {
    /// A clock that begins now.
    pub fn start() -> Self {
        Self {
            began: Instant::now(),
            began_nanos: unix_nanos(),
        }
    }

    /// Time now, nanoseconds.
    pub fn now_nanos(&self) -> u64 {
        self.nanos(Instant::now())
    }

    /// A moment on this clock, nanoseconds.
    pub fn nanos(&self, at: Instant) -> u64 {
        // One of the two differences is 0: a moment before the beginning is subtracted.
        self.began_nanos
            .saturating_add(nanos::between(self.began, at))
            .saturating_sub(nanos::between(at, self.began))
    }

    /// The moment of a time on this clock, at the earliest its beginning.
    pub fn moment(&self, at_nanos: u64) -> Instant {
        self.began + Duration::from_nanos(at_nanos.saturating_sub(self.began_nanos))
    }
}
