//! Command line of `ego-fuser`.

use std::process::ExitCode;

use bus::BusError;
use clap::Parser;
use support::cli::exit_code;
use support::command_line::parse_beside;

use crate::command::{Command, OFFLINE};

/// Fuses the views of connected vehicles into boxes around the ego.
#[derive(Debug, Parser)]
#[command(name = "ego-fuser", version, arg_required_else_help = true)]
pub struct CommandLine {
    #[command(subcommand)]
    command: Command,
}

/// Runs the subcommand on the command line.
pub fn main() -> ExitCode {
    let command_line: CommandLine = parse_beside(&OFFLINE);
    exit_code(command_line.command.run(), BusError::is_behind)
}
