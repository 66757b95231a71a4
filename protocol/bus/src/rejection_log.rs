//! What a router has refused, by the certificate of the one who tried, and whom it did not let in.

use std::collections::BTreeMap;
use std::time::Duration;

use zenoh::{Session, Wait};

use super::endpoint::Endpoint;
use super::handshake_failures;
use super::plain_tcp::PlainTcp;

/// A router answers for itself.
const ANSWER_LIMIT: Duration = Duration::from_secs(1);
/// Peers and reasons that are told apart; names are of certificates that our authority has signed.
const MAX_REFUSALS: usize = 1024;

/// Whoever did not get as far as having a name.
pub const STRANGER: &str = "stranger";

/// Why a router did not pass something on.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord)]
pub struct Rejection {
    /// Common name of the certificate, or the session's own id where there was none; [`STRANGER`] for those not let in.
    pub peer: String,
    /// `access-control`, `low-pass` or `handshake`.
    pub reason: String,
    /// What it was: `put`, `declare`, `query`; or what was wrong with the handshake.
    pub message: String,
}

/// What whoever spoke plain TCP to a router with keys did wrong.
const PLAIN_TCP: &str = "plain TCP";

/// Counts of refused messages since the router opened; of peers that have left since as far as they were seen before.
#[derive(Debug)]
pub struct RejectionLog {
    // zenoh forgets a connection that has ended.
    seen: BTreeMap<(Rejection, String), u64>,
    /// Handshakes that failed, by cause.
    strangers: BTreeMap<&'static str, u64>,
    plain_tcp: Option<PlainTcp>,
}

impl RejectionLog {
    /// Nothing yet, of the router of this process, which listens at `router`. Where that takes QUIC, whoever comes over
    /// plain TCP is turned away by the next [`Self::update`].
    #[must_use]
    pub fn of(router: &Endpoint) -> Self {
        Self { seen: BTreeMap::new(), strangers: BTreeMap::new(), plain_tcp: PlainTcp::beside(router) }
    }

    /// Asks the router of this process. What could not be asked stays as it was.
    pub fn update(&mut self, router: &Session) {
        self.strangers = handshake_failures::failed();
        let plain = self.plain_tcp.as_mut().map_or(0, PlainTcp::reject);
        if plain > 0 {
            self.strangers.insert(PLAIN_TCP, plain);
        }
        let key = format!("@/{}/router/metrics", router.zid());
        let asked =
            router.get(format!("{key}?descriptors=false;compression=false;per_key=false")).timeout(ANSWER_LIMIT);
        let Ok(answers) = asked.wait() else { return };
        while let Ok(answer) = answers.recv() {
            let Ok(sample) = answer.result() else { continue };
            let Ok(text) = sample.payload().try_to_string() else { continue };
            for ((refusal, connection), count) in text.lines().filter_map(refused) {
                if self.seen.len() < MAX_REFUSALS || self.seen.contains_key(&(refusal.clone(), connection.clone())) {
                    self.seen.insert((refusal, connection), count);
                }
            }
        }
    }

    /// How much of what was refused to whom.
    #[must_use]
    pub fn counts(&self) -> BTreeMap<Rejection, u64> {
        let mut counts = BTreeMap::new();
        for ((refusal, _), count) in &self.seen {
            *counts.entry(refusal.clone()).or_default() += count;
        }
        counts.extend(self.strangers.iter().map(|(cause, count)| {
            let [peer, reason, message] = [STRANGER, "handshake", *cause].map(str::to_owned);
            (Rejection { peer, reason, message }, *count)
        }));
        counts
    }
}

/// What zenoh calls its count of messages that came over a connection and went no further.
const DROPPED: &str = "zenoh_rx_network_message_dropped_payload_per_transport_bytes_count";

/// Reads a line of zenoh's such as
/// `zenoh_rx_network_message_dropped_payload_per_transport_bytes_count{message="put",reason="access-control",remote_cn="agent-1"} 3`.
fn refused(line: &str) -> Option<((Rejection, String), u64)> {
    let (name, rest) = line.split_once('{')?;
    if name != DROPPED {
        return None;
    }
    let (labels, count) = rest.rsplit_once('}')?;
    let label = |wanted: &str| {
        let mut known = labels.split("\",").filter_map(|label| label.split_once("=\""));
        known.find(|(name, _)| *name == wanted).map(|(_, value)| value.trim_end_matches('"').to_owned())
    };
    let reason = label("reason").filter(|reason| reason == "access-control" || reason == "low-pass")?;
    let zid = label("remote_zid").unwrap_or_default();
    let peer = label("remote_cn").filter(|name| !name.is_empty()).unwrap_or_else(|| zid.clone());
    // Each priority has a count of its own.
    let connection = format!("{zid} {}", label("priority")?);
    let refusal = Rejection { peer, reason, message: label("message")? };
    Some(((refusal, connection), count.trim().parse().ok()?))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn lines_of_zenoh_are_read() {
        let line = |name: &str, reason: &str, cn: &str| {
            format!(
                "{name}{{local_id=\"5b\",priority=\"data\",message=\"put\",protocol=\"\",reason=\"{reason}\",\
                 remote_zid=\"fb\",remote_whatami=\"client\",remote_group=\"\",remote_cn=\"{cn}\",\
                 disconnected=\"false\"}} 28"
            )
        };
        let ((refusal, connection), count) = refused(&line(DROPPED, "access-control", "agent-1")).unwrap();
        assert_eq!(
            (refusal.peer.as_str(), refusal.message.as_str(), connection.as_str()),
            ("agent-1", "put", "fb data")
        );
        assert_eq!(count, 28);
        assert_eq!(refused(&line(DROPPED, "low-pass", "")).unwrap().0.0.peer, "fb", "without a certificate");
        assert_eq!(refused(&line(DROPPED, "congestion", "agent-1")), None);
        assert_eq!(refused(&line("zenoh_rx_bytes_total", "access-control", "agent-1")), None);
        assert_eq!(refused("# EOF"), None);
    }
}
