//! Command line of `agent eval`, `agent localize` and `agent train`.

#![warn(clippy::print_stdout, clippy::print_stderr)]

mod command;
mod command_line;

use std::process::ExitCode;

use terminal::command_line::parse_behind;

fn main() -> ExitCode {
    command_line::run(parse_behind::<_, agent::command_line::CommandLine>())
}
