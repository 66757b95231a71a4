//! Watchdog: stops the heartbeats of a process whose worker thread is stalled.
//!
//! The status is published by a thread of its own, which would continue while the worker thread is stalled.

use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};

/// Activity of the thread that takes from an inbox.
#[derive(Debug, Default)]
pub(super) struct Watchdog {
    beats: AtomicU64,
    waits: AtomicBool,
}

impl Watchdog {
    /// Records activity of the thread.
    pub(super) fn beat(&self) {
        self.beats.fetch_add(1, Ordering::Relaxed);
    }

    /// Marks the thread as waiting while `waiting` runs.
    pub(super) fn wait<T>(&self, waiting: impl FnOnce() -> T) -> T {
        self.waits.store(true, Ordering::Relaxed);
        let found = waiting();
        // The beat first: in the other order a check in between would find neither beat nor wait.
        self.beat();
        self.waits.store(false, Ordering::Relaxed);
        found
    }

    /// True if the thread waits, or has been active since `beats` were counted; updates `beats`.
    pub(super) fn is_alive(&self, beats: &mut u64) -> bool {
        let before = std::mem::replace(beats, self.beats.load(Ordering::Relaxed));
        *beats != before || self.waits.load(Ordering::Relaxed)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_waiting_or_active_thread_is_alive() {
        let (watchdog, mut beats) = (Watchdog::default(), 0);
        assert!(!watchdog.is_alive(&mut beats));
        watchdog.wait(|| {
            assert!(watchdog.is_alive(&mut 0));
            assert!(watchdog.is_alive(&mut beats), "however long it waits");
        });
        assert!(watchdog.is_alive(&mut beats), "it came back");
        assert!(
            !watchdog.is_alive(&mut beats),
            "and has not been here since"
        );
        watchdog.beat();
        assert!(watchdog.is_alive(&mut beats));
    }
}
