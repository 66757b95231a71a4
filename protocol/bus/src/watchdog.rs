//! Watchdog: stops the heartbeats of a process whose worker thread is stalled.
//!
//! The status is published by a thread of its own, which would continue while the worker thread is stalled.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};

use super::status_publisher::StatusPublisher;

/// Activity of the thread that takes from an inbox.
#[derive(Debug, Default)]
pub(super) struct Watchdog {
    beats: AtomicU64,
    waits: AtomicBool,
}

impl Watchdog {
    /// Records activity of the thread.
    fn beat(&self) {
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

/// Ties the status of a process to the activity of a thread, see [`super::Bus::works_from`]; until this is dropped.
#[must_use = "the watchdog is released when this is dropped"]
pub struct Heartbeat {
    status: StatusPublisher,
    watchdog: Arc<Watchdog>,
}

impl Heartbeat {
    pub(super) fn begin(status: &StatusPublisher, watchdog: &Arc<Watchdog>) -> Self {
        status.watch(Some(Arc::clone(watchdog)));
        Self {
            status: status.clone(),
            watchdog: Arc::clone(watchdog),
        }
    }

    /// Records activity of the thread without taking from the inbox.
    pub fn beat(&self) {
        self.watchdog.beat();
    }
}

impl Drop for Heartbeat {
    fn drop(&mut self) {
        self.status.watch(None);
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
