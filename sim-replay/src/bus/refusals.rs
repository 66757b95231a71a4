//! What a router has refused, by the certificate of the one who tried.

use std::collections::BTreeMap;
use std::time::Duration;

use zenoh::{Session, Wait};

/// A router answers for itself.
const ANSWER_LIMIT: Duration = Duration::from_secs(1);
/// Peers and reasons that are told apart; names are of certificates that our authority has signed.
const MAX_REFUSALS: usize = 1024;

/// Why a router did not pass something on.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord)]
pub struct Refusal {
    /// Common name of the certificate, or the session's own id where there was none.
    pub peer: String,
    /// `access-control` or `low-pass`.
    pub reason: String,
    /// What it was: `put`, `declare`, `query`.
    pub message: String,
}

/// Counts of refused messages since the router opened; of peers that have left since as far as they were seen before.
#[derive(Debug, Default)]
pub struct Refusals {
    // zenoh forgets a connection that has ended.
    seen: BTreeMap<(Refusal, String), u64>,
}

impl Refusals {
    /// Asks the router of this process. What could not be asked stays as it was.
    pub fn update(&mut self, router: &Session) {
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
    pub fn counts(&self) -> BTreeMap<Refusal, u64> {
        let mut counts = BTreeMap::new();
        for ((refusal, _), count) in &self.seen {
            *counts.entry(refusal.clone()).or_default() += count;
        }
        counts
    }
}

/// Reads a line of zenoh's such as
/// `zenoh_rx_network_message_dropped_payload_bytes_count{..,remote_cn="agent-1",message="put",reason="access-control"} 3`.
fn refused(line: &str) -> Option<((Refusal, String), u64)> {
    let (name, rest) = line.split_once('{')?;
    if name != "zenoh_rx_network_message_dropped_payload_bytes_count" {
        return None;
    }
    let (labels, count) = rest.rsplit_once('}')?;
    let label = |wanted: &str| {
        let mut known = labels.split("\",").filter_map(|label| label.split_once("=\""));
        known.find(|(name, _)| *name == wanted).map(|(_, value)| value.trim_end_matches('"').to_owned())
    };
    let reason = label("reason").filter(|reason| reason == "access-control" || reason == "low-pass")?;
    let connection = label("remote_zid").unwrap_or_default();
    let peer = label("remote_cn").filter(|name| !name.is_empty()).unwrap_or_else(|| connection.clone());
    let refusal = Refusal { peer, reason, message: label("message")? };
    Some(((refusal, connection), count.trim().parse().ok()?))
}
