//! Who is there: liveliness tokens and those who watch for them.

use std::collections::BTreeSet;
use std::time::Duration;

use protocol::{CavId, Key, KeyExpr, ProcessId, Role, RunId, Topic};
use zenoh::sample::SampleKind;
use zenoh::{Session, Wait};

use super::{BusError, process_id};

/// How long a router may take to say who is there.
const LOOK_LIMIT: Duration = Duration::from_secs(3);

/// This process is alive, for as long as the value is.
///
/// A process that dies is missed as soon as its connection closes, which on one machine is at once; one that falls
/// silent behind a cut cable only after zenoh's lease of 10 s. Faster than that is the age of its last message.
#[must_use = "the token is withdrawn when this is dropped"]
pub struct LivelinessToken(zenoh::liveliness::LivelinessToken);

impl LivelinessToken {
    /// Tells everyone that `cav`'s process of this role is there.
    ///
    /// # Errors
    /// [`BusError::Zenoh`] when the session is closed.
    pub fn announce(session: &Session, run: &RunId, role: Role, cav: &CavId) -> Result<Self, BusError> {
        let key = Key::alive(run, role, cav).to_string();
        let token = session.liveliness().declare_token(&key).wait();
        token.map(Self).map_err(|cause| BusError::zenoh(format!("announcing {key}"), &cause))
    }

    /// Withdraws the token and waits until the session has taken note.
    ///
    /// # Errors
    /// [`BusError::Zenoh`] when the session is closed.
    pub fn withdraw(self) -> Result<(), BusError> {
        self.0.undeclare().wait().map_err(|cause| BusError::zenoh("withdrawing a liveliness token", &cause))
    }
}

/// Every process of a run that is there now.
///
/// # Errors
/// [`BusError::Zenoh`] when the session is closed.
pub fn present(session: &Session, run: &RunId) -> Result<BTreeSet<ProcessId>, BusError> {
    let selector = KeyExpr::everyone_alive(run);
    let tokens = session.liveliness().get(selector.as_str()).timeout(LOOK_LIMIT).wait();
    let tokens = tokens.map_err(|cause| BusError::zenoh(format!("looking for {selector}"), &cause))?;
    let process = |reply: zenoh::query::Reply| match reply.result().ok()?.key_expr().as_str().parse() {
        Ok(Key { topic: Topic::Alive { role, cav }, .. }) => Some(process_id(role, &cav)),
        _ => None,
    };
    Ok(std::iter::from_fn(|| tokens.recv().ok()).filter_map(process).collect())
}

/// A process came or went.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum LivelinessEvent {
    /// It is there, perhaps since long before the watch began.
    Appeared {
        /// What it does.
        role: Role,
        /// For which vehicle.
        cav: CavId,
    },
    /// It is gone.
    Vanished {
        /// What it did.
        role: Role,
        /// For which vehicle.
        cav: CavId,
    },
}

/// A watch over tokens; ends when dropped.
#[must_use = "the watch ends when this is dropped"]
pub struct LivelinessSubscription(
    #[expect(dead_code, reason = "held for its lifetime only")] zenoh::pubsub::Subscriber<()>,
);

impl LivelinessSubscription {
    /// Calls `report` for every token that `selector` meets, those present already first.
    ///
    /// `report` runs on zenoh's receive thread: it hands over and returns, and must not call zenoh.
    ///
    /// # Errors
    /// [`BusError::Zenoh`] when the session is closed.
    pub fn begin(
        session: &Session,
        selector: &KeyExpr,
        report: impl Fn(LivelinessEvent) + Send + Sync + 'static,
    ) -> Result<Self, BusError> {
        let watch = session.liveliness().declare_subscriber(selector.as_str()).history(true).callback(move |sample| {
            // A token that is no key of ours says nothing to us.
            if let Ok(Key { topic: Topic::Alive { role, cav }, .. }) = sample.key_expr().as_str().parse() {
                report(match sample.kind() {
                    SampleKind::Put => LivelinessEvent::Appeared { role, cav },
                    SampleKind::Delete => LivelinessEvent::Vanished { role, cav },
                });
            }
        });
        watch.wait().map(Self).map_err(|cause| BusError::zenoh(format!("watching {selector}"), &cause))
    }
}
