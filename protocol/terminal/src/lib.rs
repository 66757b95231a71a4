//! Terminal: what programs for people need and the processes of a vehicle do not.
//!
//! [`text_table`] lays out tables; [`progress`] draws bars; [`command_line`] parses, and writes shell completions and
//! manual pages.

#![warn(clippy::print_stdout, clippy::print_stderr)]

pub mod command_line;
pub mod progress;
pub mod text_table;
