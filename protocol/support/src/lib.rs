//! Program support: file access, terminal output and seeded randomness that all programs share.
//!
//! - [`bounded_file`]: reads of outside files with a limit on their size.
//! - [`atomic_file`]: files that appear complete or not at all.
//! - [`output`]: standard output and error that survive a closed pipe.
//! - [`sibling_program`]: subcommands that another program carries out.
//! - [`random`]: seeds derived from seeds, and draws that depend on nothing else.

#![warn(clippy::print_stdout, clippy::print_stderr)]

pub mod atomic_file;
pub mod bounded_file;
pub mod output;
pub mod random;
pub mod sibling_program;
