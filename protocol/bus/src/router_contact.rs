//! Contact with the router: since when, and for how long in all, a process has had no connection to it.

use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use support::sync::lock;
use zenoh::config::WhatAmI;
use zenoh::sample::SampleKind;
use zenoh::session::TransportEvent;
use zenoh::{Session, Wait};

use super::BusError;

/// Times without a connection to the router. The router's own session never loses it.
#[derive(Debug, Clone, Default)]
pub(super) struct RouterContact(Arc<Mutex<ContactState>>);

#[derive(Debug, Default)]
struct ContactState {
    lost_at: Option<Instant>,
    /// Sum of the times that are over.
    lost: Duration,
}

impl RouterContact {
    /// Follows the connections of `session`.
    ///
    /// # Errors
    /// [`BusError::Zenoh`] when the session is closed.
    pub(super) fn watch(session: &Session) -> Result<Self, BusError> {
        let contact = Self::default();
        let noted = contact.clone();
        let info = session.info();
        let listener = info.transport_events_listener();
        let listener = listener.callback(move |event: TransportEvent| {
            if event.transport().whatami() == WhatAmI::Router {
                noted.note(event.kind() == SampleKind::Put, Instant::now());
            }
        });
        let declared = listener.background().wait();
        declared.map_err(|cause| BusError::zenoh("watching the connection", &cause))?;
        Ok(contact)
    }

    fn note(&self, is_connected: bool, now: Instant) {
        let mut state = lock(&self.0);
        if !is_connected {
            state.lost_at.get_or_insert(now);
        } else if let Some(lost_at) = state.lost_at.take() {
            state.lost += now.saturating_duration_since(lost_at);
        }
    }

    /// Time since which there is no connection.
    pub(super) fn lost_since(&self) -> Option<Instant> {
        lock(&self.0).lost_at
    }

    /// Time without a connection so far.
    pub(super) fn lost(&self) -> Duration {
        let state = lock(&self.0);
        let since = state.lost_at.as_ref().map(Instant::elapsed);
        state.lost + since.unwrap_or_default()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_time_without_a_connection_is_the_sum_of_all() {
        let (contact, at) = (RouterContact::default(), Instant::now());
        let after = |seconds| at + Duration::from_secs(seconds);
        contact.note(true, at);
        contact.note(false, after(1));
        contact.note(false, after(2));
        assert_eq!(contact.lost_since(), Some(after(1)));
        contact.note(true, after(4));
        assert_eq!(
            (contact.lost_since(), contact.lost()),
            (None, Duration::from_secs(3))
        );
        contact.note(false, after(5));
        contact.note(true, after(6));
        assert_eq!(contact.lost(), Duration::from_secs(4));
    }
}
