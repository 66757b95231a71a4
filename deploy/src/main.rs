//! Command line of `v2vloc`.

#![warn(clippy::print_stdout, clippy::print_stderr)]

mod command;

use std::process::ExitCode;

use bus::BusError;
use clap::Parser;
use support::cli::exit_code;
use support::command_line::parse_beside;

/// Collaborative perception without GNSS as a distributed system: run, evaluate and view it.
#[derive(Debug, Parser)]
#[command(
    name = "v2vloc",
    version,
    arg_required_else_help = true,
    after_help = "Exit codes: 0 done, 1 failed, 2 bad usage or input, 3 finished but data was lost beyond what the \
                  link dropped."
)]
struct CommandLine {
    #[command(subcommand)]
    command: command::Command,
}

fn main() -> ExitCode {
    let command_line: CommandLine = parse_beside(&command::RUNNER);
    bus::log_to_stderr();
    exit_code(command_line.command.run(), BusError::is_behind)
}
