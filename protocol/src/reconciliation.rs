//! Whether the books of a run add up.

use std::collections::BTreeSet;
use std::fmt;

use serde::{Deserialize, Serialize};

use crate::Account;
use crate::Counts;
use crate::Ledger;
use crate::ProcessId;
use crate::Topic;

/// What [`Ledger::balance`] finds.
#[derive(Debug, Clone, PartialEq, Eq, Default, Serialize, Deserialize)]
pub struct Reconciliation {
    /// Accounts whose numbers do not add up.
    pub differences: Vec<Discrepancy>,
    /// Topics that nobody subscribed to: sent, lost to no one.
    pub unheard: Vec<UnreceivedTopic>,
}

/// One account that does not add up.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Discrepancy {
    /// The topic.
    pub topic: Topic,
    /// The receiving process, where one is known.
    pub to: Option<ProcessId>,
    /// Sent less received, dropped and in flight: positive, messages vanished; negative, messages came from nowhere.
    pub missing: i64,
    /// The numbers that do not add up.
    pub counts: Counts,
}

/// A topic without a receiver.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct UnreceivedTopic {
    /// The topic.
    pub topic: Topic,
    /// Messages published.
    pub messages: u64,
}

impl Reconciliation {
    /// Whether every message is accounted for.
    #[must_use]
    pub fn is_exact(&self) -> bool {
        self.differences.is_empty()
    }

    pub(crate) fn of(ledger: &Ledger) -> Self {
        let mut balance = Self::default();
        let heard: BTreeSet<&Topic> =
            ledger.iter().filter_map(|(account, _)| account.to.as_ref().map(|_| &account.topic)).collect();
        for (account, counts) in ledger.iter() {
            let mut counts = counts.clone();
            if account.to.is_some() {
                // What is counted without a receiver holds for each.
                if let Some(published) = ledger.get(&Account::published(account.topic.clone())) {
                    counts.add(published);
                }
                balance.push_difference(account, counts);
            } else if !heard.contains(&account.topic) {
                match u64::try_from(counts.missing()) {
                    Ok(0) => {}
                    Ok(messages) => balance.unheard.push(UnreceivedTopic { topic: account.topic.clone(), messages }),
                    Err(_) => balance.push_difference(account, counts),
                }
            }
        }
        balance
    }

    fn push_difference(&mut self, account: &Account, counts: Counts) {
        let missing = counts.missing();
        if missing != 0 {
            let Account { topic, to } = account.clone();
            // MessageStats of real runs are far from the ends of the range; hostile ones may be cut there.
            let missing = missing.clamp(i64::MIN.into(), i64::MAX.into()) as i64;
            self.differences.push(Discrepancy { topic, to, missing, counts });
        }
    }
}

impl fmt::Display for Discrepancy {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { topic, to, missing, counts } = self;
        let to = to.as_ref().map(|to| format!(" to {to}")).unwrap_or_default();
        let (verb, count) = if *missing > 0 { ("vanished", *missing) } else { ("came from nowhere", -missing) };
        write!(
            f,
            "{topic}{to}: {count} {verb} (sent {}, received {}, dropped {}, in flight {})",
            counts.sent,
            counts.received,
            counts.dropped_total(),
            counts.in_flight
        )
    }
}
