//! Command line of `agent eval`, `agent localize` and `agent train`.

#![warn(clippy::print_stdout, clippy::print_stderr)]

mod cli;
mod command;

use std::process::ExitCode;

use clap::Parser;

fn main() -> ExitCode {
    cli::run(cli::Cli::parse())
}
