//! Who was away for a while during a run, and of whose messages therefore nobody can tell what became of them.
//!
//! The books of a process that is killed end with what it told last, up to half a second before; what is sent to one that
//! is not there, or over a connection that breaks, arrives nowhere. Such accounts are exempted by name, in the ledger and
//! in the report; all others have to add up.

use std::collections::BTreeSet;
use std::sync::{Arc, Mutex, PoisonError};

use bus::{Bus, BusError, LivelinessEvent, LivelinessSubscription, process_id};
use protocol::{Account, Role, Stream, Topic};

const ROLES: [Role; 4] = [Role::Agent, Role::Ego, Role::Link, Role::Replay];

/// Notes who vanishes and comes back.
pub struct OfflineIntervals {
    state: Arc<Mutex<State>>,
    _watches: Vec<LivelinessSubscription>,
}

#[derive(Default)]
struct State {
    /// Gone now.
    gone: BTreeSet<String>,
    /// Were gone and came back.
    returned: BTreeSet<String>,
}

impl OfflineIntervals {
    /// Watches everyone on `bus`.
    ///
    /// # Errors
    /// [`BusError::Zenoh`] when the session is closed.
    pub fn watch(bus: &Bus) -> Result<Self, BusError> {
        let state = Arc::<Mutex<State>>::default();
        let watch = |role| {
            let state = Arc::clone(&state);
            bus.watch(role, move |sighting| {
                let mut state = state.lock().unwrap_or_else(PoisonError::into_inner);
                match sighting {
                    LivelinessEvent::Vanished { role, cav } => {
                        state.gone.insert(process_id(role, &cav).to_string());
                    }
                    LivelinessEvent::Appeared { role, cav } => {
                        let name = process_id(role, &cav).to_string();
                        if state.gone.remove(&name) {
                            state.returned.insert(name);
                        }
                    }
                }
            })
        };
        Ok(Self { _watches: ROLES.into_iter().map(watch).collect::<Result<_, _>>()?, state })
    }

    /// Who was away so far, by process. One that is gone for good counts too, but for the replay, which goes when the scene
    /// is over.
    #[must_use]
    pub fn so_far(&self) -> BTreeSet<String> {
        let state = self.state.lock().unwrap_or_else(PoisonError::into_inner);
        let replay = Role::Replay.to_string();
        state.returned.iter().chain(state.gone.iter().filter(|name| **name != replay)).cloned().collect()
    }
}

/// Whether one of those whom an account concerns was away: who sends, who receives, the link between.
#[must_use]
pub fn concerns(away: &BTreeSet<String>, account: &Account) -> bool {
    let replay = Role::Replay.to_string();
    let agent = |cav| process_id(Role::Agent, cav).to_string();
    let mut concerned: Vec<String> = match &account.topic {
        Topic::Stream { stream: Stream::Lidar | Stream::Gnss | Stream::Radar | Stream::Camera(_), .. }
        | Topic::Truth => {
            vec![replay]
        }
        Topic::Stream { cav, stream: Stream::Detections | Stream::DetectionsJson } => {
            vec![process_id(Role::Ego, cav).to_string()]
        }
        Topic::Stream { cav, .. } => vec![agent(cav)],
        Topic::Received { ego, cav, .. } => vec![agent(cav), process_id(Role::Link, ego).to_string()],
        Topic::Control(_) | Topic::Ready(_) | Topic::Stats(_) | Topic::Alive { .. } => Vec::new(),
    };
    if let Some(to) = &account.to {
        concerned.push(to.to_string());
        // What an ego hears may have come through its link.
        concerned.extend(to.as_str().strip_prefix("ego-").map(|ego| format!("link-{ego}")));
    }
    concerned.iter().any(|name| away.contains(name))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_account_concerns_sender_receiver_and_link() {
        let concerns = |topic: &str, to: &str, away: &str| {
            let account = Account::towards(topic.parse().unwrap(), &to.parse().unwrap());
            super::concerns(&BTreeSet::from([away.to_owned()]), &account)
        };
        for (topic, to, away) in [
            ("20/bev", "ego-10", "agent-20"),
            ("20/bev", "ego-10", "ego-10"),
            ("20/bev", "ego-10", "link-10"),
            ("20/lidar", "agent-20", "replay"),
            ("truth", "scorer", "replay"),
            ("10/detections", "scorer", "ego-10"),
        ] {
            assert!(concerns(topic, to, away), "{topic} {to} {away}");
            assert!(!concerns(topic, to, "agent-30"), "{topic} {to}");
        }
        assert!(!concerns("20/lidar", "agent-20", "link-10"));
    }
}
