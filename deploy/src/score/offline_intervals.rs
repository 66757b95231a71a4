//! Offline intervals of processes: messages to or from an offline process are exempt from reconciliation.
//!
//! The counters of a process that is killed end with its last report, up to half a second before; a message to an
//! offline process, or over a connection that breaks, arrives nowhere. Such accounts are exempt, by name, in the ledger
//! and in the report; all others have to balance.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::{Arc, Mutex};

use bus::{Bus, BusError, Subscription, process_id};
use protocol::{Account, Role, Topic};
use support::sync::lock;

const ROLES: [Role; 4] = [Role::Agent, Role::Ego, Role::Link, Role::Replay];

/// Records the processes that leave and rejoin.
pub(crate) struct OfflineIntervals {
    /// Processes that have left, each with whether it has rejoined since.
    departed: Arc<Mutex<BTreeMap<String, bool>>>,
    _watches: Vec<Subscription>,
}

impl OfflineIntervals {
    /// Watches every role on `bus`.
    ///
    /// # Errors
    /// [`BusError::Zenoh`] when the session is closed.
    pub(crate) fn watch(bus: &Bus) -> Result<Self, BusError> {
        let departed = Arc::<Mutex<BTreeMap<_, _>>>::default();
        let watches = ROLES.into_iter().map(|role| {
            let departed = Arc::clone(&departed);
            bus.watch(role, move |cav, is_there| {
                let name = process_id(role, &cav).to_string();
                let mut departed = lock(&departed);
                let process = departed.entry(name);
                if is_there {
                    process.and_modify(|rejoined| *rejoined = true);
                } else {
                    process.or_insert(false);
                }
            })
        });
        Ok(Self {
            _watches: watches.collect::<Result<_, _>>()?,
            departed,
        })
    }

    /// Processes that were offline so far. One that does not return counts too, except the replay, which leaves when
    /// the scene is over.
    pub(crate) fn so_far(&self) -> BTreeSet<String> {
        let departed = lock(&self.departed);
        let mut counted = departed.clone();
        counted.retain(|name, rejoined| *rejoined || name != Role::Replay.as_str());
        counted.into_keys().collect()
    }
}

/// True if a process that the account concerns was offline: sender, receiver or the link between them.
pub fn concerns(offline: &BTreeSet<String>, account: &Account) -> bool {
    let replay = Role::Replay.to_string();
    let mut concerned: Vec<String> = match &account.topic {
        Topic::Truth => vec![replay],
        Topic::Stream { cav, stream } => match stream.sender() {
            Role::Replay => vec![replay],
            role => vec![process_id(role, cav).to_string()],
        },
        Topic::Received { ego, cav, .. } => vec![
            process_id(Role::Agent, cav).to_string(),
            process_id(Role::Link, ego).to_string(),
        ],
        Topic::Control(_) | Topic::Ready(_) | Topic::Stats(_) | Topic::Alive { .. } => Vec::new(),
    };
    if let Some(to) = &account.to {
        concerned.push(to.to_string());
        // An ego receives messages of neighbours through its link.
        let ego = to.as_str().strip_prefix("ego-");
        concerned.extend(ego.map(|ego| format!("link-{ego}")));
    }
    concerned.iter().any(|name| offline.contains(name))
}

#[cfg(test)]
mod tests {
    use super::*;

    /// True if messages of the topic to that process concern the offline one.
    fn is_concerned(topic: &str, to: &str, offline: &str) -> bool {
        let account = Account::towards(topic.parse().unwrap(), &to.parse().unwrap());
        concerns(&BTreeSet::from([offline.to_owned()]), &account)
    }

    #[test]
    fn an_account_concerns_sender_receiver_and_link() {
        for (topic, to, offline) in [
            ("20/bev", "ego-10", "agent-20"),
            ("20/bev", "ego-10", "ego-10"),
            ("20/bev", "ego-10", "link-10"),
            ("20/lidar", "agent-20", "replay"),
            ("truth", "scorer", "replay"),
            ("10/detections", "scorer", "ego-10"),
            ("10/tracks", "scorer", "ego-10"),
        ] {
            assert!(is_concerned(topic, to, offline), "{topic} {to} {offline}");
            assert!(!is_concerned(topic, to, "agent-30"), "{topic} {to}");
        }
        assert!(!is_concerned("20/lidar", "agent-20", "link-10"));
    }
}
