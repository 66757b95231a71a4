//! Command line of `v2vloc`.

use std::process::ExitCode;

use bus::BusError;
use clap::Parser;
use support::cli::exit_code;
use support::command_line::parse_beside;

use crate::command::{Command, RUNNER};

/// Collaborative perception without GNSS as a distributed system: run, evaluate and view it.
#[derive(Debug, Parser)]
#[command(
    name = "v2vloc",
    version,
    arg_required_else_help = true,
    after_help = "Exit codes: 0 done, 1 failed, 2 bad usage or input, 3 finished but data was lost beyond what the \
                  link dropped."
)]
pub struct CommandLine {
    #[command(subcommand)]
    command: Command,
}

/// Runs the subcommand on the command line.
pub fn main() -> ExitCode {
    let command_line: CommandLine = parse_beside(&RUNNER);
    bus::log_to_stderr();
    exit_code(command_line.command.run(), BusError::is_behind)
}
