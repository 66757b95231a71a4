//! Refusal watch: the requests that the router of a run refuses.

use std::collections::BTreeMap;
use std::thread::{self, JoinHandle};
use std::time::{Duration, Instant};

use bus::shutdown::Stop;
use bus::{BusError, RejectionLog, Result, RouterRejection};

use crate::operate::network::RouterEndpoint;

/// Interval at which the refusals of a run's router are read.
const LOOK_ROUND: Duration = Duration::from_secs(1);

/// Reads the refusals of a run's router.
pub struct RefusalWatch {
    stop: Stop,
    thread: Option<JoinHandle<RejectionLog>>,
}

impl RefusalWatch {
    /// Follows the router of this process; one that runs elsewhere keeps its own log.
    ///
    /// # Errors
    /// [`BusError::Thread`] when the system gives no thread.
    pub fn over(place: &RouterEndpoint) -> Result<Self> {
        let stop = Stop::new();
        if !place.is_guarded {
            return Ok(Self { stop, thread: None });
        }
        let (session, ending) = (place.session.clone(), stop.clone());
        let mut refusals = RejectionLog::of(&place.endpoint);
        let builder = thread::Builder::new().name("refusals".into());
        let thread = builder.spawn(move || {
            loop {
                let ended = ending.wait_until(Instant::now() + LOOK_ROUND);
                // Once more after the request, so that the last refusals count.
                refusals.update(&session);
                if ended {
                    return refusals;
                }
            }
        });
        let thread = thread.map_err(|cause| BusError::Thread {
            what: "refusals".into(),
            cause,
        })?;
        Ok(Self {
            stop,
            thread: Some(thread),
        })
    }

    /// All refusals, which are also logged.
    pub fn finish(mut self) -> BTreeMap<RouterRejection, u64> {
        self.stop.request();
        let read = self.thread.take().and_then(|thread| thread.join().ok());
        let counts = read.map_or_else(BTreeMap::new, |all| all.counts());
        for (refused, count) in &counts {
            let (peer, reason, what) = (&refused.peer, &refused.reason, &refused.message);
            tracing::warn!(%peer, %reason, %what, count, "refused by the router");
        }
        counts
    }
}

impl Drop for RefusalWatch {
    fn drop(&mut self) {
        self.stop.request();
    }
}
