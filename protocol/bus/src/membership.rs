//! Who of a role comes and goes, for a thread that asks when it has time.

use std::sync::Arc;
use std::time::Instant;

use protocol::{CavId, Role};

use super::bounded_queue::{BoundedQueue, Pop, PushOutcome};
use super::liveliness::{LivelinessEvent, LivelinessSubscription};
use super::{Bus, BusError};

/// Sightings that wait to be asked for; of one vehicle only the last.
pub struct Membership {
    sightings: Arc<BoundedQueue<CavId, bool>>,
    _watch: LivelinessSubscription,
}

impl Membership {
    /// Watches the processes of a role, those already there first. Of more than `most` vehicles at once some are passed
    /// over, and the log says so: a flood of tokens must not become a flood of anything else.
    ///
    /// # Errors
    /// [`BusError::Zenoh`] when the session is closed.
    pub fn begin(bus: &Bus, role: Role, most: usize) -> Result<Self, BusError> {
        let sightings = Arc::new(BoundedQueue::new(1, most));
        let watch = bus.watch(role, {
            let sightings = Arc::clone(&sightings);
            move |sighting| {
                let (cav, is_there) = match sighting {
                    LivelinessEvent::Appeared { cav, .. } => (cav, true),
                    LivelinessEvent::Vanished { cav, .. } => (cav, false),
                };
                if let PushOutcome::NoLane(_) = sightings.push(cav.clone(), is_there) {
                    tracing::warn!(%cav, "more processes come and go than can be followed");
                }
            }
        })?;
        Ok(Self { sightings, _watch: watch })
    }

    /// Somebody who came (`true`) or went since the last time; none when there is nobody left to tell of.
    #[must_use]
    pub fn next(&self) -> Option<(CavId, bool)> {
        match self.sightings.take(Some(Instant::now())) {
            Pop::Item(cav, is_there) => Some((cav, is_there)),
            Pop::TimedOut | Pop::Closed => None,
        }
    }
}
