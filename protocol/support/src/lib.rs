//! Program support: common functions of all programs that no crate of the field offers.
//!
//! - [`command_line`]: parsing, verbosity; [`cli`]: errors and exit codes; [`output`]: standard output and error;
//!   [`sibling_program`]: subcommands that another program executes; [`shared_files`]: files that come with the programs.
//! - [`bounded_file`], [`atomic_file`], [`config_file`], [`csv_file`], [`file_digests`]: reads with a limit on their size,
//!   atomic writes, YAML, CSV, SHA-256 of whole files; errors name the file ([`file_error`]).
//! - [`statistics`], [`stage_times`], [`nanos`]: quantiles and correlations, the stopwatch, durations in nanoseconds;
//!   [`sync`]: locks.
//! - [`provenance`]: the command, programs and digests that a result was made from.
//! - [`rounding`]: floats to integers; [`sampling`]: parts of lists.
//! - [`sweep_log`]: arrival of each sweep at an agent, for whoever times a run; [`record_log`]: records of a process.
//! - [`random`]: seeds derived from seeds, and draws that depend on the seed only.
//!
//! ```
//! use support::statistics::{median, quantile, sorted};
//!
//! let latency_ms = [27.0, 31.0, 29.0, 58.0];
//! assert_eq!(median(&latency_ms), Some(30.0));
//! assert_eq!(quantile(&sorted(&latency_ms), 1.0), Some(58.0));
//! ```

// This crate reads what other processes and people wrote: an index or a cast that does not fit is an error there, not
// a panic or another number.
#![cfg_attr(not(test), deny(clippy::cast_possible_truncation))]
#![cfg_attr(not(test), deny(clippy::cast_sign_loss))]
#![cfg_attr(not(test), deny(clippy::indexing_slicing))]
#![warn(clippy::print_stdout, clippy::print_stderr)]

pub mod atomic_file;
pub mod bounded_file;
pub mod cli;
pub mod command_line;
pub mod config_file;
pub mod csv_file;
pub mod file_digests;
pub mod file_error;
mod list_values;
pub mod nanos;
pub mod output;
pub mod provenance;
pub mod random;
pub mod record_log;
pub mod rounding;
pub mod sampling;
pub mod shared_files;
pub mod sibling_program;
pub mod stage_times;
pub mod statistics;
pub mod sweep_log;
pub mod sync;
mod unknown_field;
