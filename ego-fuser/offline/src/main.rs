//! Command line of `ego-fuser align`, `eval`, `residual` and `train`.

#![warn(clippy::print_stdout, clippy::print_stderr)]

mod command;

use std::process::ExitCode;

use clap::Parser;
use ego_fuser::command_line::CommandLine as Front;
use support::cli::exit_code;
use terminal::command_line::parse_behind;

/// Training and evaluation of collaborative detection.
#[derive(Debug, Parser)]
#[command(
    name = "ego-fuser",
    bin_name = "ego-fuser",
    version,
    arg_required_else_help = true,
    after_help = "Exit codes: 0 done, 1 failed, 2 bad usage or input, 3 data could not be used and were left out, 130 \
                  a training was stopped by Ctrl-C."
)]
struct CommandLine {
    #[command(subcommand)]
    command: command::Command,
}

fn main() -> ExitCode {
    exit_code(parse_behind::<CommandLine, Front>().command.run(), |_| {
        false
    })
}
