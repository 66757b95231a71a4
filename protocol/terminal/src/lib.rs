//! Terminal: what programs for people need and the processes of a vehicle do not.
//!
//! [`text_table`] lays out tables; [`command_line`] parses, and writes shell completions and manual pages.

#![warn(clippy::print_stdout, clippy::print_stderr)]

pub mod command_line;
pub mod text_table;
