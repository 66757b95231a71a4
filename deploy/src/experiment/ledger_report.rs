//! `ledger.json`: every process's books, their sum, and whether it balances.

use std::collections::{BTreeMap, BTreeSet};

use bus::Rejection;
use protocol::{Counts, Ledger, Reconciliation, StageSummary};
use serde::Serialize;

use crate::experiment::score::ProcessBooks;

/// The books of a run.
#[derive(Debug, Clone, Serialize)]
pub struct LedgerReport {
    /// Whether every message that was sent is received, dropped for a reason, or in flight.
    pub balances: bool,
    /// What does not add up, and topics that nobody listened to.
    pub balance: Reconciliation,
    /// Processes that were away for a while.
    pub away: BTreeSet<String>,
    /// Messages of which nobody can tell what became of them, because one of those was away.
    pub exempted: u64,
    /// Everything added up.
    pub total: Counts,
    /// All processes together, by topic and receiver.
    pub sum: Ledger,
    /// What the router of the run did not let through: by whom, what, why.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub refused: Vec<RefusedReport>,
    /// The last word of each process; one that was started again is there once for each life.
    pub processes: Vec<ProcessReport>,
}

/// What the router did not let one peer say.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct RefusedReport {
    /// Whose certificate it showed.
    pub peer: String,
    /// `put`, `declare`, `query`.
    pub message: String,
    /// `access-control` or `low-pass`.
    pub reason: String,
    /// How often.
    pub count: u64,
}

/// The books of one life of a process.
#[derive(Debug, Clone, Serialize)]
pub struct ProcessReport {
    /// Its name.
    pub process: String,
    /// Its messages.
    pub ledger: Ledger,
    /// How long its stages took.
    pub stages: Vec<StageSummary>,
}

impl LedgerReport {
    /// The report on `books`, whose sum is `sum`; who was away, and what is exempted by that.
    #[must_use]
    pub fn new(
        books: &[ProcessBooks],
        sum: &Ledger,
        balance: &Reconciliation,
        (away, exempted): (&BTreeSet<String>, u64),
    ) -> Self {
        let process = |books: &ProcessBooks| ProcessReport {
            process: books.process.to_string(),
            ledger: books.ledger.clone(),
            stages: books.stages.clone(),
        };
        Self {
            balances: balance.is_exact(),
            balance: balance.clone(),
            away: away.clone(),
            exempted,
            total: sum.total(),
            sum: sum.clone(),
            refused: Vec::new(),
            processes: books.iter().map(process).collect(),
        }
    }

    /// The same with what the router of the run refused.
    #[must_use]
    pub fn with_refused(self, refused: &BTreeMap<Rejection, u64>) -> Self {
        let refused = refused.iter().map(|(Rejection { peer, message, reason }, count)| RefusedReport {
            peer: peer.clone(),
            message: message.clone(),
            reason: reason.clone(),
            count: *count,
        });
        Self { refused: refused.collect(), ..self }
    }
}
