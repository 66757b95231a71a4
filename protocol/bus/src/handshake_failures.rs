//! Failed handshakes, counted by cause from zenoh's log, the only place that reports them.

use std::collections::BTreeMap;
use std::fmt;
use std::sync::Mutex;

use support::sync::lock;
use tracing::field::{Field, Visit};
use tracing::{Event, Subscriber};
use tracing_subscriber::layer::{Context, Layer};

/// Log target of zenoh's QUIC listener, and its text for failed connections.
const ACCEPTOR: &str = "zenoh_link_commons::quic";
const FAILED: &str = "QUIC acceptor failed";

/// Texts of rustls and quinn with their meaning; the first match counts.
const CAUSES: [(&str, &str); 6] = [
    ("expired", "expired certificate"),
    ("UnknownIssuer", "certificate of another authority"),
    // An authority with the same name.
    ("BadSignature", "certificate of another authority"),
    ("sent no certificates", "no certificate"),
    ("TimedOut", "begun and not finished"),
    ("Closed", "broken off by the other side"),
];
const OTHER: &str = "other";

/// Counts since this process began, which has one router at most.
static COUNTS: Mutex<BTreeMap<&'static str, u64>> = Mutex::new(BTreeMap::new());

/// Log layer that counts them.
pub(super) struct HandshakeCounter;

impl<S: Subscriber> Layer<S> for HandshakeCounter {
    fn on_event(&self, event: &Event<'_>, _: Context<'_, S>) {
        if !event.metadata().target().starts_with(ACCEPTOR) {
            return;
        }
        let mut text = EventText(String::new());
        event.record(&mut text);
        if text.0.contains(FAILED) {
            *lock(&COUNTS).entry(cause(&text.0)).or_default() += 1;
        }
    }
}

/// Number of failed handshakes so far, by cause.
pub(super) fn failed() -> BTreeMap<&'static str, u64> {
    lock(&COUNTS).clone()
}

fn cause(text: &str) -> &'static str {
    let known = CAUSES.iter().find(|(pattern, _)| text.contains(pattern));
    known.map_or(OTHER, |(_, cause)| cause)
}

/// The text of an event.
struct EventText(String);

impl Visit for EventText {
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
        tracing::subscriber::with_default(
            tracing_subscriber::registry().with(HandshakeCounter),
            || {
                let reason = "invalid peer certificate: UnknownIssuer";
                tracing::warn!(target: "zenoh_link_commons::quic::unicast", "{FAILED}: TransportError({reason:?}). Hint");
                tracing::warn!(target: "zenoh_link_commons::quic::unicast", "something else");
                tracing::warn!(target: "elsewhere", "{FAILED}: TimedOut");
            },
        );
        let more =
            |cause: &str| failed().get(cause).unwrap_or(&0) - before.get(cause).unwrap_or(&0);
        assert_eq!(
            (
                more("certificate of another authority"),
                more("begun and not finished")
            ),
            (1, 0)
        );
        assert_eq!(
            cause("QUIC acceptor failed: TimedOut"),
            "begun and not finished"
        );
        assert_eq!(cause("QUIC acceptor failed: Reset"), OTHER);
    }
}
