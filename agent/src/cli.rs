//! The sub-commands and the exit codes they share.

use std::process::ExitCode;

use agent::process;
use anyhow::Context;
use clap::{Parser, Subcommand};
use sim_replay::bus::BusError;
use sim_replay::dataset::LeftOut;
use sim_replay::output;

use crate::command;

/// What one connected vehicle does with its sweeps: where am I, what do I see, what do I tell the others.
#[derive(Debug, Parser)]
#[command(
    version,
    after_help = "Exit codes: 0 done, 1 failed, 2 bad usage or input, 3 data could not be used and were left out."
)]
pub(crate) struct Cli {
    #[command(subcommand)]
    command: Command,
}

#[derive(Debug, Subcommand)]
enum Command {
    Run(command::run::Args),
    Eval(command::eval::Args),
    Localize(command::localize::Args),
    Train(command::train::Args),
}

/// Usage or input at fault, and not the program: exit code 2.
#[derive(Debug, thiserror::Error)]
#[error(transparent)]
pub(crate) struct BadInput(pub(crate) anyhow::Error);

/// The end of a command that did not fail.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Outcome {
    /// All data were used.
    Done,
    /// Data were left out: exit code 3.
    DataLost,
}

impl Outcome {
    /// Prints what was left out, if anything was.
    pub(crate) fn of(left_out: &LeftOut) -> Self {
        for problem in left_out.problems() {
            output::note(format_args!("left out: {}", problem.message));
        }
        if left_out.is_nothing() { Self::Done } else { Self::DataLost }
    }
}

/// Runs what was asked for and prints the chain of causes where it failed.
pub(crate) fn run(cli: Cli) -> ExitCode {
    let kept = process::ensure(&process::KEPT_MEMORY).context("this program again");
    let outcome = kept.and_then(|()| match cli.command {
        Command::Run(args) => command::run::run(&args).map(|()| Outcome::Done),
        Command::Eval(args) => command::eval::run(&args),
        Command::Localize(args) => command::localize::run(&args),
        Command::Train(args) => command::train::run(&args).map(|()| Outcome::Done),
    });
    match outcome {
        Ok(Outcome::Done) => ExitCode::SUCCESS,
        Ok(Outcome::DataLost) => ExitCode::from(3),
        Err(error) => {
            output::note(format_args!("error: {error:#}"));
            let is_bad_input = error.is::<BadInput>() || BusError::is_behind(error.as_ref());
            if is_bad_input { ExitCode::from(2) } else { ExitCode::FAILURE }
        }
    }
}
