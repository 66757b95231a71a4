//! The operator's side of the fleet: reads a scenario, starts and supervises the processes, scores what the ego
//! reports and writes it down.
//!
//! - [`scenario`]: what is asked for; [`fleet`]: which processes that takes.
//! - [`up`]: one run, with its [`network`], [`supervise`]d processes and [`score`].
//! - [`stepped`]: the same in virtual time.
//! - [`evaluation`]: the same numbers without a network; [`table`]: many of them; [`sweep`]: grids of them in virtual time.
//! - [`view`]: a page to look at a run, live or recorded.
//! - [`run_folder`], [`metrics`], [`ledger_report`], [`picture`]: what is kept of it.

#![warn(clippy::print_stdout, clippy::print_stderr)]

pub mod absences;
mod crew_processes;
pub mod evaluation;
mod failures;
pub mod fingerprint;
pub mod fleet;
pub mod health;
pub mod keys;
pub mod ledger_report;
pub mod metrics;
pub mod network;
pub mod picture;
pub mod progress;
pub mod report;
pub mod run_folder;
pub mod scenario;
pub mod score;
pub mod security;
pub mod showcase;
pub mod status;
pub mod stepped;
pub mod supervise;
pub mod sweep;
pub mod table;
pub mod up;
pub mod view;
mod watch;
pub mod weights_choice;
