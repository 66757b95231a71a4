//! Command line of `ego-fuser`.

#![warn(clippy::print_stdout, clippy::print_stderr)]

mod command;

use std::process::ExitCode;

use bus::BusError;
use clap::Parser;
use support::cli::exit_code;
use support::command_line::parse_beside;

/// Fuses the views of connected vehicles into boxes around the ego.
#[derive(Debug, Parser)]
#[command(name = "ego-fuser", version, arg_required_else_help = true)]
struct CommandLine {
    #[command(subcommand)]
    command: command::Command,
}

fn main() -> ExitCode {
    exit_code(
        parse_beside::<CommandLine>(&command::OFFLINE).command.run(),
        BusError::is_behind,
    )
}
