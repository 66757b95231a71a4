//! The sub-commands and the exit codes they share.

use std::process::ExitCode;

use clap::{Parser, Subcommand};

use bus::BusError;
use support::output;

use crate::command;

/// Scenes: look into recorded ones, generate new ones, stream either as live traffic, record what comes of it.
#[derive(Debug, Parser)]
#[command(
    version,
    after_help = "Exit codes: 0 done, 1 failed, 2 bad usage or input, 3 finished but data was lost (convert, stream: frames \
                  that cannot be read; stream: ticks that are not answered; record and recover: messages that are \
                  missing; link: messages that never arrive)."
)]
pub(crate) struct Cli {
    #[command(subcommand)]
    command: Command,
}

#[derive(Debug, Subcommand)]
enum Command {
    Convert(command::convert::Args),
    Inspect(command::inspect::Args),
    Link(command::link::Args),
    Record(command::record::Args),
    Recover(command::recover::Args),
    Stream(command::stream::Args),
    Synth(command::synth::Args),
}

/// How a command that did not fail ended.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Outcome {
    /// All went well.
    Done,
    /// The input is wrong; what is wrong has been said.
    BadInput,
    /// Finished, but not everything of the input came through.
    DataLost,
}

/// Runs what was asked for and prints the chain of causes where it failed.
pub(crate) fn run(cli: Cli) -> ExitCode {
    let outcome = match cli.command {
        Command::Convert(args) => command::convert::run(&args),
        Command::Inspect(args) => command::inspect::run(&args),
        Command::Link(args) => command::link::run(&args),
        Command::Record(args) => command::record::run(&args),
        Command::Recover(args) => command::recover::run(&args),
        Command::Stream(args) => command::stream::run(&args),
        Command::Synth(args) => command::synth::run(args),
    };
    match outcome {
        Ok(Outcome::Done) => ExitCode::SUCCESS,
        Ok(Outcome::BadInput) => ExitCode::from(2),
        Ok(Outcome::DataLost) => ExitCode::from(3),
        Err(error) => {
            output::note(format_args!("error: {error:#}"));
            if BusError::is_behind(error.as_ref()) { ExitCode::from(2) } else { ExitCode::FAILURE }
        }
    }
}
