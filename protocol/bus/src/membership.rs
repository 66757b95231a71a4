//! Membership: processes of a role that join and leave, for a thread that polls.

use std::sync::Arc;
use std::time::Instant;

use protocol::{CavId, Role};

use super::bounded_queue::{BoundedQueue, Pop, PushOutcome};
use super::{Bus, BusError, Subscription};

/// Liveliness events that wait to be polled; only the last of each vehicle is kept.
pub struct Membership {
    events: Arc<BoundedQueue<CavId, bool>>,
    _watch: Subscription,
}

impl Membership {
    /// Subscribes to the processes of a role, present ones first. Of more than `most` vehicles at once some are
    /// skipped, with a warning in the log: a flood of tokens must not cause a flood of work.
    ///
    /// # Errors
    /// [`BusError::Zenoh`] when the session is closed.
    pub fn begin(bus: &Bus, role: Role, most: usize) -> Result<Self, BusError> {
        let events = Arc::new(BoundedQueue::new(1, most));
        let subscription = bus.watch(role, {
            let events = Arc::clone(&events);
            move |cav: CavId, is_there| {
                if let PushOutcome::NoLane(_) = events.push(cav.clone(), is_there) {
                    tracing::warn!(%cav, "more processes join and leave than can be tracked");
                }
            }
        })?;
        Ok(Self {
            events,
            _watch: subscription,
        })
    }

    /// The next vehicle that joined (`true`) or left since the last call; `None` if there is none.
    pub fn next(&self) -> Option<(CavId, bool)> {
        match self.events.take(Some(Instant::now())) {
            Pop::Item(cav, is_there) => Some((cav, is_there)),
            Pop::TimedOut | Pop::Closed => None,
        }
    }
}
