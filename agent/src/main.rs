//! Command line of `agent`.

#![warn(clippy::print_stdout, clippy::print_stderr)]

mod command;
mod command_line;

use std::process::ExitCode;

fn main() -> ExitCode {
    command_line::run(support::command_line::parse_beside(&command_line::OFFLINE))
}
