//! `ledger.json`: every process's books, their sum, and whether it balances.

use std::collections::BTreeSet;

use protocol::{Balance, Counts, Ledger, StageSummary};
use serde::Serialize;

use crate::score::ProcessBooks;

/// The books of a run.
#[derive(Debug, Clone, Serialize)]
pub struct LedgerReport {
    /// Whether every message that was sent is received, dropped for a reason, or in flight.
    pub balances: bool,
    /// What does not add up, and topics that nobody listened to.
    pub balance: Balance,
    /// Processes that were away for a while.
    pub away: BTreeSet<String>,
    /// Messages of which nobody can tell what became of them, because one of those was away.
    pub excused: u64,
    /// Everything added up.
    pub total: Counts,
    /// All processes together, by topic and receiver.
    pub sum: Ledger,
    /// The last word of each process; one that was started again is there once for each life.
    pub processes: Vec<ProcessReport>,
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
    /// The report on `books`, whose sum is `sum`; who was away, and what is excused by that.
    #[must_use]
    pub fn new(
        books: &[ProcessBooks],
        sum: &Ledger,
        balance: &Balance,
        (away, excused): (&BTreeSet<String>, u64),
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
            excused,
            total: sum.total(),
            sum: sum.clone(),
            processes: books.iter().map(process).collect(),
        }
    }
}
