//! Liveliness tokens of processes, and subscriptions to them.

use std::collections::BTreeSet;
use std::time::Duration;

use protocol::{CavId, Key, KeyExpr, ProcessId, Role, Topic};
use zenoh::sample::SampleKind;
use zenoh::{Session, Wait};

use super::{Bus, BusError, Subscription, process_id};
use crate::Result;

/// Timeout of a liveliness query to the router.
const QUERY_TIMEOUT: Duration = Duration::from_secs(3);

/// Liveliness token: this process is alive until the value is dropped.
///
/// The token of a process that dies is withdrawn as soon as its connection closes, at once on one machine; after a cut
/// link only when zenoh's lease of 10 s expires. The age of the last message shows it earlier.
#[must_use = "the token is withdrawn when this is dropped"]
pub struct LivelinessToken(zenoh::liveliness::LivelinessToken);

impl LivelinessToken {
    /// Withdraws the token and waits until the session has processed it.
    ///
    /// # Errors
    /// [`BusError::Zenoh`] when the session is closed.
    pub fn withdraw(self) -> Result<()> {
        let withdrawn = self.0.undeclare().wait();
        withdrawn.map_err(|cause| BusError::zenoh("withdrawing a liveliness token", &cause))
    }
}

/// Processes with a token that `selector` matches, which are alive now.
///
/// # Errors
/// [`BusError::Zenoh`] when the session is closed.
pub fn present(session: &Session, selector: &str) -> Result<BTreeSet<ProcessId>> {
    let holders = tokens(session, selector)?.filter_map(|token| holder(&token));
    Ok(holders.map(|(role, cav)| process_id(role, &cav)).collect())
}

/// Keys of the liveliness tokens that `selector` matches, of this project and of others.
///
/// # Errors
/// [`BusError::Zenoh`] when the session is closed.
pub fn tokens(session: &Session, selector: &str) -> Result<impl Iterator<Item = String>> {
    let liveliness = session.liveliness();
    let tokens = liveliness.get(selector).timeout(QUERY_TIMEOUT).wait();
    let tokens =
        tokens.map_err(|cause| BusError::zenoh(format!("looking for {selector}"), &cause))?;
    let replies = std::iter::from_fn(move || tokens.recv().ok());
    Ok(replies.filter_map(|reply| Some(reply.result().ok()?.key_expr().to_string())))
}

/// Role and vehicle of the process that holds a token; `None` for a token outside this key grammar.
fn holder(token: &str) -> Option<(Role, CavId)> {
    let Topic::Alive { role, cav } = token.parse::<Key>().ok()?.topic else {
        return None;
    };
    Some((role, cav))
}

impl Bus {
    /// Declares the liveliness token of this process in its role.
    ///
    /// # Errors
    /// [`BusError::Zenoh`] when the session is closed.
    pub fn announce(&self, role: Role) -> Result<LivelinessToken> {
        let identity = self.identity();
        let key = Key::alive(&identity.run, role, &identity.cav).to_string();
        let token = self.session().liveliness().declare_token(&key).wait();
        token
            .map(LivelinessToken)
            .map_err(|cause| BusError::zenoh(format!("announcing {key}"), &cause))
    }

    /// Subscribes to the liveliness of the processes of a role, present ones first: the vehicle of each that joins
    /// (`true`), possibly long before, or leaves.
    ///
    /// `report` runs on zenoh's receive thread: it hands over and returns, and must not call zenoh.
    ///
    /// # Errors
    /// [`BusError::Zenoh`] when the session is closed.
    pub fn watch(
        &self,
        role: Role,
        report: impl Fn(CavId, bool) + Send + Sync + 'static,
    ) -> Result<Subscription> {
        let tokens = KeyExpr::alive(&self.identity().run, role);
        let liveliness = self.session().liveliness();
        let subscriber = liveliness
            .declare_subscriber(tokens.as_str())
            .history(true)
            .callback(move |sample| {
                if let Some((_, cav)) = holder(sample.key_expr().as_str()) {
                    report(cav, sample.kind() == SampleKind::Put);
                }
            });
        subscriber
            .wait()
            .map(|_held| Subscription { _held })
            .map_err(|cause| BusError::zenoh(format!("watching {tokens}"), &cause))
    }
}
