//! Reconciliation of senders' and receivers' counters at the end of a run.

use std::collections::BTreeSet;
use std::fmt;

use serde::{Deserialize, Serialize};

use crate::{Account, Counts, Ledger, ProcessId, Topic};

/// Result of [`Ledger::balance`].
#[derive(Debug, Clone, PartialEq, Eq, Default, Serialize, Deserialize)]
pub struct Reconciliation {
    /// Accounts that do not balance.
    pub discrepancies: Vec<Discrepancy>,
    /// Topics without any receiver; their messages are not lost.
    pub unreceived: Vec<UnreceivedTopic>,
}

/// One account that does not balance.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Discrepancy {
    /// The topic.
    pub topic: Topic,
    /// The receiving process, if one is known.
    pub to: Option<ProcessId>,
    /// Sent minus received, dropped and in flight: positive, messages are missing; negative, there are surplus
    /// messages.
    pub missing: i64,
    /// The counters that do not balance.
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
    /// True if every message is accounted for.
    pub fn is_exact(&self) -> bool {
        self.discrepancies.is_empty()
    }

    pub(crate) fn of(ledger: &Ledger) -> Self {
        let mut balance = Self::default();
        let received: BTreeSet<&Topic> = ledger
            .iter()
            .filter_map(|(account, _)| account.to.as_ref().map(|_| &account.topic))
            .collect();
        for (account, counts) in ledger.deliveries() {
            balance.push_difference(account, counts);
        }
        for (account, counts) in ledger.iter() {
            if received.contains(&account.topic) {
                continue;
            }
            match u64::try_from(counts.missing()) {
                Ok(0) => {}
                Ok(messages) => balance.unreceived.push(UnreceivedTopic {
                    topic: account.topic.clone(),
                    messages,
                }),
                Err(_) => balance.push_difference(account, counts.clone()),
            }
        }
        balance
    }

    fn push_difference(&mut self, account: &Account, counts: Counts) {
        let missing = counts.missing();
        if missing != 0 {
            let Account { topic, to } = account.clone();
            // Counters of real runs are far from the ends of the range; hostile ones may be clamped.
            let missing =
                i64::try_from(missing).unwrap_or(if missing < 0 { i64::MIN } else { i64::MAX });
            self.discrepancies.push(Discrepancy {
                topic,
                to,
                missing,
                counts,
            });
        }
    }
}

impl fmt::Display for Discrepancy {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let counts = &self.counts;
        let (topic, to) = (self.topic.clone(), self.to.clone());
        let account = Account { topic, to };
        let (verb, count) = match self.missing {
            missing @ 1.. => ("not accounted for", missing.unsigned_abs()),
            missing => ("received but never sent", missing.unsigned_abs()),
        };
        write!(
            f,
            "{account}: {count} {verb} (sent {}, received {}, dropped {}, in flight {})",
            counts.sent,
            counts.received,
            counts.dropped_total(),
            counts.in_flight
        )
    }
}
