//! Handshakes that fail, by what was wrong with them: zenoh says so in its log and nowhere else.

use std::collections::BTreeMap;
use std::fmt;
use std::sync::{Mutex, MutexGuard, PoisonError};

use tracing::field::{Field, Visit};
use tracing::{Event, Subscriber};
use tracing_subscriber::layer::{Context, Layer};

/// Where zenoh takes in connections over QUIC, and what it says of those that come to nothing.
const ACCEPTOR: &str = "zenoh_link_commons::quic";
const FAILED: &str = "QUIC acceptor failed";

/// What rustls and quinn say, and what that means; the first that fits counts.
const CAUSES: [(&str, &str); 6] = [
    ("expired", "expired certificate"),
    ("UnknownIssuer", "certificate of another authority"),
    // One that bears the same name.
    ("BadSignature", "certificate of another authority"),
    ("sent no certificates", "no certificate"),
    ("TimedOut", "begun and not finished"),
    ("Closed", "broken off by the other side"),
];
const OTHER: &str = "other";

/// Since this process began, which has one router at most.
static COUNTS: Mutex<BTreeMap<&'static str, u64>> = Mutex::new(BTreeMap::new());

/// A listener to the log that counts them.
pub(super) struct HandshakeCounter;

impl<S: Subscriber> Layer<S> for HandshakeCounter {
    fn on_event(&self, event: &Event<'_>, _: Context<'_, S>) {
        if !event.metadata().target().starts_with(ACCEPTOR) {
            return;
        }
        let mut said = Said(String::new());
        event.record(&mut said);
        if said.0.contains(FAILED) {
            *counts().entry(cause(&said.0)).or_default() += 1;
        }
    }
}

/// How many failed so far, by cause.
pub(super) fn failed() -> BTreeMap<&'static str, u64> {
    counts().clone()
}

fn counts() -> MutexGuard<'static, BTreeMap<&'static str, u64>> {
    COUNTS.lock().unwrap_or_else(PoisonError::into_inner)
}

fn cause(said: &str) -> &'static str {
    CAUSES.iter().find(|(words, _)| said.contains(words)).map_or(OTHER, |(_, cause)| cause)
}

/// The text of an event.
struct Said(String);

impl Visit for Said {
    fn record_debug(&mut self, field: &Field, value: &dyn fmt::Debug) {
        if field.name() == "message" {
            self.0 = format!("{value:?}");
        }
    }
}

#[cfg(test)]
mod tests {
    use tracing_subscriber::layer::SubscriberExt;

    use super::*;

    #[test]
    fn failed_handshakes_are_counted_by_cause() {
        let before = failed();
        tracing::subscriber::with_default(tracing_subscriber::registry().with(HandshakeCounter), || {
            let reason = "invalid peer certificate: UnknownIssuer";
            tracing::warn!(target: "zenoh_link_commons::quic::unicast", "{FAILED}: TransportError({reason:?}). Hint");
            tracing::warn!(target: "zenoh_link_commons::quic::unicast", "something else");
            tracing::warn!(target: "elsewhere", "{FAILED}: TimedOut");
        });
        let more = |cause: &str| failed().get(cause).unwrap_or(&0) - before.get(cause).unwrap_or(&0);
        assert_eq!((more("certificate of another authority"), more("begun and not finished")), (1, 0));
        assert_eq!(cause("QUIC acceptor failed: TimedOut"), "begun and not finished");
        assert_eq!(cause("QUIC acceptor failed: Reset"), OTHER);
    }
}
