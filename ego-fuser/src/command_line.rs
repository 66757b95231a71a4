//! Command line of `ego-fuser`.

use std::process::ExitCode;

use bus::BusError;
use clap::Parser;
use support::cli::exit_code;
use support::command_line::parse_beside;

use crate::command::{Command, OFFLINE};

/// Fuses the views of connected vehicles into boxes around the ego.
#[derive(Debug, Parser)]
#[command(
    name = "ego-fuser",
    version,
    arg_required_else_help = true,
    after_help = "Exit codes: 0 done, 1 failed, 2 bad usage or input, 3 data could not be used and were left out, 130 \
                  a training was stopped by Ctrl-C."
)]
pub struct CommandLine {
    #[command(subcommand)]
    command: Command,
}

/// Runs the subcommand on the command line.
pub fn main() -> ExitCode {
    let command_line: CommandLine = parse_beside(&OFFLINE);
    exit_code(command_line.command.run(), BusError::is_behind)
}
