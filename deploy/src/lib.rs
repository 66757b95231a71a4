//! Operator's tool: starts and supervises a fleet, runs experiments on it and shows it.
//!
//! - [`scenario`]: the file that describes a run.
//! - [`operate`]: processes, network, keys, health, the run folder.
//! - [`experiment`]: offline evaluation, tables, sweeps in simulation time, metrics and reports.
//! - [`view`]: a page that shows a run, live or recorded, and its pictures.

#![warn(clippy::print_stdout, clippy::print_stderr)]

pub mod experiment;
pub mod operate;
pub mod scenario;
pub mod schema;
pub mod view;
