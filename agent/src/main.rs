//! Command line of `agent`.

#![warn(clippy::print_stdout, clippy::print_stderr)]

mod command;
mod command_line;

use std::process::ExitCode;

use clap::Parser;

fn main() -> ExitCode {
    command_line::run(command_line::Cli::parse())
}
