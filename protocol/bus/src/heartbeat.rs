//! Heartbeat of a worker thread: ties the status of a process to the activity of the thread.

use std::sync::Arc;

use super::status_publisher::StatusPublisher;
use super::watchdog::Watchdog;

/// Ties the status of a process to the activity of a thread, see [`super::Bus::works_from`]; until this is dropped.
#[must_use = "the watchdog is released when this is dropped"]
pub struct Heartbeat {
    pub(super) status: StatusPublisher,
    pub(super) watchdog: Arc<Watchdog>,
}

impl Heartbeat {
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
