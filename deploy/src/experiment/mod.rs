//! Experiments: evaluation, tables and sweeps, and their metrics and reports.

pub mod evaluation;
pub mod fingerprint;
pub mod ledger_report;
pub mod metrics;
pub mod progress;
pub mod report;
pub mod score;
pub mod stepped;
pub mod sweep;
pub mod table;
pub mod weights_choice;
