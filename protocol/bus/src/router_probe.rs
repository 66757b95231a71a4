//! Router probe: a session of its own that has to receive, through the router, what another session publishes.
//!
//! A router whose threads wait for each other passes no message any more, without a panic and without an end.

use std::mem;
use std::sync::{Arc, Mutex};
use std::thread;
use std::time::{Duration, Instant};

use support::sync::{lock, spawn};
use zenoh::{Session, Wait};

use super::access_control::PROBE_KEY;
use super::session::declare_subscriber;
use super::shutdown;
use super::{BusError, BusOptions, open};

/// Interval of these probes.
const PERIOD: Duration = Duration::from_millis(500);
/// The most that one look adds to the silence: a longer time since the look before is one in which this program itself
/// had no processor, which is no evidence about the router.
const STEP: Duration = Duration::from_millis(300);
/// Longest time for closing the session.
const CLOSE_LIMIT: Duration = Duration::from_millis(500);

/// A session that receives through a router, and the time of the last arrival.
pub struct RouterProbe {
    arrived: Arc<Mutex<Instant>>,
    /// Time of the last look, the arrival that it has found, and the silence since.
    looked: (Instant, Instant, Duration),
    /// Session and subscriber, held for their lifetime.
    connection: (Session, zenoh::pubsub::Subscriber<()>),
}

impl RouterProbe {
    /// Subscribes with the `client` options to `key`, on which another session publishes at least twice a second.
    ///
    /// # Errors
    /// [`BusError`], as [`open`].
    pub fn of_key(client: &BusOptions, key: &str) -> Result<Self, BusError> {
        let session = open(client)?;
        let now = Instant::now();
        let arrived = Arc::new(Mutex::new(now));
        let noted = Arc::clone(&arrived);
        let subscriber =
            declare_subscriber(&session, key, move |_| *lock(&noted) = Instant::now())?;
        Ok(Self {
            arrived,
            looked: (now, now, Duration::ZERO),
            connection: (session, subscriber),
        })
    }

    /// A probe of the router in this process, `router`, which it reaches with the `client` options: it publishes too.
    ///
    /// # Errors
    /// [`BusError`], as [`open`].
    pub fn of_router(router: &Session, client: &BusOptions) -> Result<Self, BusError> {
        let probe = Self::of_key(client, PROBE_KEY)?;
        // A weak reference: the thread ends with the probe instead of keeping it alive.
        let (router, alive) = (router.clone(), Arc::downgrade(&probe.arrived));
        // On a thread: at a router that fails it waits for ever.
        let thread = spawn("router-probe", move || {
            while alive.strong_count() > 0 && router.put(PROBE_KEY, [0_u8; 1]).wait().is_ok() {
                thread::sleep(PERIOD);
            }
        });
        thread.map_err(BusError::thread("router-probe"))?;
        Ok(probe)
    }

    /// Time at `now` for which nothing has come through the router while this program ran. To be asked for five times a
    /// second.
    pub fn silence(&mut self, now: Instant) -> Duration {
        let arrived = *lock(&self.arrived);
        let (looked, known, silence) = self.looked;
        let step = now.saturating_duration_since(looked).min(STEP);
        let silence = if arrived > known {
            Duration::ZERO
        } else {
            silence + step
        };
        self.looked = (now, arrived, silence);
        silence
    }

    /// Closes the session, unless the router has failed: that would never end, or abort the process.
    pub fn end(self, has_failed: bool) {
        if has_failed {
            mem::forget(self);
        } else if let Err(overdue) = shutdown::within(CLOSE_LIMIT, "the router's probe", || {
            drop(self.connection);
        }) {
            tracing::warn!("{overdue}");
        }
    }
}

#[cfg(test)]
mod tests {
    use std::net::TcpListener;

    use protocol::KeyExpr;

    use super::*;
    use crate::Endpoint;

    #[test]
    fn a_probe_comes_back_and_a_key_without_messages_is_silent() {
        let port = { TcpListener::bind("127.0.0.1:0").unwrap() }.local_addr();
        let endpoint = Endpoint::loopback(port.unwrap().port());
        let router = open(&BusOptions::router(endpoint.clone())).unwrap();
        let client = BusOptions::client(endpoint);
        let mut probe = RouterProbe::of_router(&router, &client).unwrap();
        let key = KeyExpr::stats(&"r1".parse().unwrap());
        let mut nothing = RouterProbe::of_key(&client, key.as_str()).unwrap();
        let began = Instant::now();
        let mut longest = Duration::ZERO;
        while nothing.silence(Instant::now()) < 3 * PERIOD {
            longest = longest.max(probe.silence(Instant::now()));
            thread::sleep(Duration::from_millis(50));
        }
        assert!(began.elapsed() >= 3 * PERIOD - Duration::from_millis(100));
        assert!(longest < 3 * PERIOD, "{longest:?}");
        let (now, pause) = (Instant::now(), Duration::from_secs(20));
        let before = nothing.silence(now);
        assert_eq!(nothing.silence(now + pause), before + STEP, "after a pause");
        probe.end(false);
        nothing.end(false);
    }
}
