//! Rejections of a router: rejected messages by certificate, and failed handshakes by cause.

use std::collections::BTreeMap;
use std::time::Duration;

use serde::{Deserialize, Serialize};
use zenoh::{Session, Wait};

use super::endpoint::Endpoint;
use super::handshake_failures;
use super::plain_tcp::PlainTcp;

/// Timeout of a query to the router of this process.
const QUERY_TIMEOUT: Duration = Duration::from_secs(1);
/// Maximum number of distinct peers and reasons; names are those of certificates signed by our authority.
const MAX_REJECTIONS: usize = 1024;

/// Name of peers that are not authenticated.
const UNAUTHORISED: &str = "unauthorised";

/// Rejection of a message or of a connection by a router.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
pub struct RouterRejection {
    /// Common name of the certificate, or the session's id without one; `UNAUTHORISED` for peers not admitted.
    pub peer: String,
    /// `access-control`, `low-pass` or `handshake`.
    pub reason: String,
    /// Operation: `put`, `declare`, `query`; or the cause of the failed handshake.
    pub message: String,
}

/// Cause of a rejected plain-TCP connection to a router with keys.
const PLAIN_TCP: &str = "plain TCP";

/// Counts of rejected messages since the router opened; for peers that have left, up to the last update before.
#[derive(Debug)]
pub struct RejectionLog {
    // zenoh drops the counters of a connection that has ended.
    seen: BTreeMap<(RouterRejection, String), u64>,
    /// Failed handshakes, by cause.
    failed_handshakes: BTreeMap<&'static str, u64>,
    plain_tcp: Option<PlainTcp>,
}

impl RejectionLog {
    /// Empty counts of the router of this process, which listens at `router`. If that is a QUIC endpoint, the next
    /// [`Self::update`] closes connections over plain TCP.
    pub fn of(router: &Endpoint) -> Self {
        Self {
            seen: BTreeMap::new(),
            failed_handshakes: BTreeMap::new(),
            plain_tcp: PlainTcp::beside(router),
        }
    }

    /// Queries the router of this process. Counts that cannot be queried stay as they were.
    pub fn update(&mut self, router: &Session) {
        self.failed_handshakes = handshake_failures::failed();
        let plain = self.plain_tcp.as_mut().map_or(0, PlainTcp::reject);
        if plain > 0 {
            self.failed_handshakes.insert(PLAIN_TCP, plain);
        }
        let key = format!("@/{}/router/metrics", router.zid());
        let selector = format!("{key}?descriptors=false;compression=false;per_key=false");
        let query = router.get(selector).timeout(QUERY_TIMEOUT);
        let Ok(answers) = query.wait() else { return };
        while let Ok(answer) = answers.recv() {
            if let Ok(sample) = answer.result()
                && let Ok(text) = sample.payload().try_to_string()
            {
                // Adds the counts of zenoh's metrics.
                for (connection, count) in text.lines().filter_map(rejected) {
                    if self.seen.len() < MAX_REJECTIONS || self.seen.contains_key(&connection) {
                        // A count of zenoh is the total of its connection so far: it replaces the one before.
                        self.seen.insert(connection, count);
                    }
                }
            }
        }
    }

    /// Number of rejections.
    pub fn counts(&self) -> BTreeMap<RouterRejection, u64> {
        let mut counts = BTreeMap::new();
        for ((rejection, _), count) in &self.seen {
            *counts.entry(rejection.clone()).or_default() += count;
        }
        for (cause, count) in &self.failed_handshakes {
            let [peer, reason, message] = [UNAUTHORISED, "handshake", *cause].map(str::to_owned);
            let rejection = RouterRejection {
                peer,
                reason,
                message,
            };
            counts.insert(rejection, *count);
        }
        counts
    }
}

/// zenoh's metric of messages that arrived over a connection and were dropped.
const DROPPED: &str = "zenoh_rx_network_message_dropped_payload_per_transport_bytes_count";

/// Reads a line of zenoh's metrics such as
/// `zenoh_rx_network_message_dropped_payload_per_transport_bytes_count{message="put",reason="access-control",remote_cn="agent-1"}
/// 3`.
fn rejected(line: &str) -> Option<((RouterRejection, String), u64)> {
    let rest = line.strip_prefix(DROPPED)?.strip_prefix('{')?;
    let (labels, count) = rest.rsplit_once('}')?;
    let reason = label(labels, "reason")
        .filter(|reason| reason == "access-control" || reason == "low-pass")?;
    let zid = label(labels, "remote_zid").unwrap_or_default();
    let peer = label(labels, "remote_cn")
        .filter(|name| !name.is_empty())
        .unwrap_or_else(|| zid.clone());
    // Each priority has a count of its own.
    let connection = format!("{zid} {}", label(labels, "priority")?);
    let rejection = RouterRejection {
        peer,
        reason,
        message: label(labels, "message")?,
    };
    Some(((rejection, connection), count.trim().parse().ok()?))
}

fn label(labels: &str, wanted: &str) -> Option<String> {
    let mut known = labels
        // Split at quote and comma: a value may contain a comma.
        .split("\",")
        .filter_map(|label| label.split_once("=\""));
    let (_, value) = known.find(|(name, _)| *name == wanted)?;
    Some(value.trim_end_matches('"').to_owned())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn metric_line(name: &str, reason: &str, cn: &str) -> String {
        format!(
            "{name}{{local_id=\"5b\",priority=\"data\",message=\"put\",protocol=\"\",reason=\"{reason}\",\
             remote_zid=\"fb\",remote_whatami=\"client\",remote_group=\"\",remote_cn=\"{cn}\",\
             disconnected=\"false\"}} 28"
        )
    }

    #[test]
    fn lines_of_zenoh_are_read() {
        let ((rejection, connection), count) =
            rejected(&metric_line(DROPPED, "access-control", "agent-1")).unwrap();
        assert_eq!(
            (
                rejection.peer.as_str(),
                rejection.message.as_str(),
                connection.as_str()
            ),
            ("agent-1", "put", "fb data")
        );
        assert_eq!(count, 28);
        let ((rejection, _), _) = rejected(&metric_line(DROPPED, "low-pass", "")).unwrap();
        assert_eq!(rejection.peer, "fb", "without a certificate");
        let congestion = metric_line(DROPPED, "congestion", "agent-1");
        assert_eq!(rejected(&congestion), None);
        let another_metric = metric_line("zenoh_rx_bytes_total", "access-control", "agent-1");
        assert_eq!(rejected(&another_metric), None);
        assert_eq!(rejected("# EOF"), None);
    }
}
