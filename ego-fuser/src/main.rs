//! Command line of `ego-fuser`.

#![warn(clippy::print_stdout, clippy::print_stderr)]

mod command;

use std::process::ExitCode;

use clap::Parser;
use support::output;

/// Fuses the views of connected vehicles into boxes around the ego.
#[derive(Debug, Parser)]
#[command(name = "ego-fuser", version, arg_required_else_help = true)]
struct CommandLine {
    #[command(subcommand)]
    command: command::Command,
}

fn main() -> ExitCode {
    let command_line = CommandLine::parse();
    match command_line.command.run() {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            output::note(format_args!("ego-fuser: {error:#}"));
            command::exit_code(&error)
        }
    }
}
