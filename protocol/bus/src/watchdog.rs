//! Whether the thread that does a process's work still does.
//!
//! A thread of its own says how a process is. It would go on saying so for a process whose work stands still.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};

use super::status_publisher::StatusPublisher;

/// What an inbox knows of the thread that takes from it.
#[derive(Debug, Default)]
pub(super) struct Watchdog {
    beats: AtomicU64,
    waits: AtomicBool,
}

impl Watchdog {
    /// The thread is here.
    pub(super) fn beat(&self) {
        self.beats.fetch_add(1, Ordering::Relaxed);
    }

    /// The thread waits for work for as long as `waiting` takes.
    pub(super) fn wait<T>(&self, waiting: impl FnOnce() -> T) -> T {
        self.waits.store(true, Ordering::Relaxed);
        let found = waiting();
        self.beat();
        self.waits.store(false, Ordering::Relaxed);
        found
    }

    /// Whether the thread waits, or has been here since `beats` were counted, which are counted anew.
    pub(super) fn is_alive(&self, beats: &mut u64) -> bool {
        let before = std::mem::replace(beats, self.beats.load(Ordering::Relaxed));
        *beats != before || self.waits.load(Ordering::Relaxed)
    }
}

/// A process that says how it is only while a thread works, see [`super::Bus::works_from`]; until this is dropped.
#[must_use = "the work is over when this is dropped"]
pub struct Heartbeat {
    notices: StatusPublisher,
    pulse: Arc<Watchdog>,
}

impl Heartbeat {
    pub(super) fn begin(notices: &StatusPublisher, pulse: &Arc<Watchdog>) -> Self {
        notices.watch(Some(Arc::clone(pulse)));
        Self { notices: notices.clone(), pulse: Arc::clone(pulse) }
    }

    /// The thread is here, though it takes nothing from its inbox.
    pub fn beat(&self) {
        self.pulse.beat();
    }
}

impl Drop for Heartbeat {
    fn drop(&mut self) {
        self.notices.watch(None);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn who_waits_or_came_by_is_alive_and_who_does_neither_is_not() {
        let (pulse, mut beats) = (Watchdog::default(), 0);
        assert!(!pulse.is_alive(&mut beats));
        pulse.wait(|| {
            assert!(pulse.is_alive(&mut 0));
            assert!(pulse.is_alive(&mut beats), "however long it waits");
        });
        assert!(pulse.is_alive(&mut beats), "it came back");
        assert!(!pulse.is_alive(&mut beats), "and has not been here since");
        pulse.beat();
        assert!(pulse.is_alive(&mut beats));
    }
}
