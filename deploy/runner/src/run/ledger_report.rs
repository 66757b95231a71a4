//! `ledger.json`: the ledger of every process, their sum, and the discrepancies.

use std::collections::{BTreeMap, BTreeSet};

use bus::Rejection;
use deploy::score::ProcessStats;
use protocol::{Counts, Ledger, Reconciliation, StageSummary};
use serde::Serialize;

/// Message accounting of a run.
#[derive(Debug, Clone, Serialize)]
pub(crate) struct LedgerReport {
    /// True if every message that was sent is received, dropped for a reason, or in flight.
    pub balances: bool,
    /// Discrepancies, and topics without subscribers.
    pub balance: Reconciliation,
    /// Processes that were offline for some time.
    pub away: BTreeSet<String>,
    /// Number of messages that are exempt from reconciliation, because one of those was offline.
    pub exempted: u64,
    /// Sum over all accounts.
    pub total: Counts,
    /// Sum over all processes, by topic and receiver.
    pub sum: Ledger,
    /// Requests that the router of the run refused: peer, message, reason.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub refused: Vec<RefusedReport>,
    /// Last report of each process; a restarted one has an entry per instance.
    pub processes: Vec<ProcessReport>,
}

/// Requests of one peer that the router refused.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub(crate) struct RefusedReport {
    /// Common name of its certificate.
    pub peer: String,
    /// `put`, `declare`, `query`.
    pub message: String,
    /// `access-control` or `low-pass`.
    pub reason: String,
    /// Number of refusals.
    pub count: u64,
}

/// Ledger of one process instance.
#[derive(Debug, Clone, Serialize)]
pub(crate) struct ProcessReport {
    /// Name of the process.
    pub process: String,
    /// Its message counters.
    pub ledger: Ledger,
    /// Durations of its stages.
    pub stages: Vec<StageSummary>,
}

impl LedgerReport {
    /// Report on `ledgers`, whose sum is `sum`; processes that were offline, and the number of messages exempt for
    /// that.
    pub(crate) fn new(
        ledgers: &[ProcessStats],
        sum: &Ledger,
        balance: &Reconciliation,
        (away, exempted): (&BTreeSet<String>, u64),
    ) -> Self {
        let process = |instance: &ProcessStats| ProcessReport {
            process: instance.process.to_string(),
            ledger: instance.ledger.clone(),
            stages: instance.stages.clone(),
        };
        Self {
            balances: balance.is_exact(),
            balance: balance.clone(),
            away: away.clone(),
            exempted,
            total: sum.total(),
            sum: sum.clone(),
            refused: Vec::new(),
            processes: ledgers.iter().map(process).collect(),
        }
    }

    /// Adds the requests that the router of the run refused.
    pub(crate) fn with_refused(self, refused: &BTreeMap<Rejection, u64>) -> Self {
        let refused = refused.iter().map(|(of, count)| RefusedReport {
            peer: of.peer.clone(),
            message: of.message.clone(),
            reason: of.reason.clone(),
            count: *count,
        });
        Self {
            refused: refused.collect(),
            ..self
        }
    }
}
