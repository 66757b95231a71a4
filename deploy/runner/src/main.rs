//! Command line of `v2vloc demo`, `up`, `eval`, `sweep` and `schema`.

#![warn(clippy::print_stdout, clippy::print_stderr)]

mod command;

use std::process::ExitCode;

use clap::Parser;
use deploy::command_line::CommandLine as Front;
use support::cli::exit_code;
use terminal::command_line::parse_behind;

/// Runs and experiments that compute networks.
#[derive(Debug, Parser)]
#[command(
    name = "v2vloc",
    bin_name = "v2vloc",
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
    let command_line = parse_behind::<CommandLine, Front>();
    bus::log_to_stderr();
    exit_code(command_line.command.run(), command::is_bad_input)
}
