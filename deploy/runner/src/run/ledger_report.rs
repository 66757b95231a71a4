//! `ledger.json`: the ledger of every process, their sum, and the discrepancies.

use std::collections::BTreeSet;

use deploy::operate::router_report::RefusalCount;
use deploy::score::ProcessStats;
use protocol::{Counts, Ledger, Reconciliation};
use serde::Serialize;

/// Message accounting of a run.
#[derive(Debug, Clone, Default, Serialize)]
pub(crate) struct LedgerReport {
    /// True if every message that was sent is received, dropped for a reason, or in flight.
    pub balances: bool,
    /// Discrepancies, and topics without subscribers.
    pub balance: Reconciliation,
    /// Processes that were offline for some time.
    pub offline: BTreeSet<String>,
    /// Number of messages that are exempt from reconciliation, because one of those was offline.
    pub exempted: u64,
    /// Sum over all receivers.
    pub total: Counts,
    /// Sum over all processes, by topic and receiver.
    pub sum: Ledger,
    /// Requests that the router of the run refused: peer, message, reason.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub refused: Vec<RefusalCount>,
    /// Observed causes of lost messages: outages of the router, pauses of the run, ends of processes.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub causes: Vec<String>,
    /// Last report of each process; a restarted one has an entry per instance.
    pub processes: Vec<ProcessStats>,
}
