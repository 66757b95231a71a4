//! Experiments: evaluation, tables and sweeps, and their metrics and reports.

pub mod cell;
mod check;
pub mod evaluation;
mod frame_files;
mod load;
pub mod report;
pub mod slices;
pub mod spec;
pub mod sweep;
pub mod table;
pub mod without_effect;
