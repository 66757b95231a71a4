//! Command line of `ego-fuser`.

mod command;

use std::process::ExitCode;

use clap::Parser;

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
            eprintln!("ego-fuser: {error:#}");
            command::exit_code(&error)
        }
    }
}
