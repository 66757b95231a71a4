//! Command line of `sim-replay`.

#![warn(clippy::print_stdout, clippy::print_stderr)]

mod command;
mod command_line;

use std::process::ExitCode;

fn main() -> ExitCode {
    command_line::run(terminal::command_line::parse())
}
