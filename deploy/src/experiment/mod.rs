//! Experiments: evaluation, tables and sweeps, and their metrics and reports.

pub mod evaluation;
pub mod report;
pub mod sweep;
pub mod table;
