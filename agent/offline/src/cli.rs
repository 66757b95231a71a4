//! Subcommands of the agent that read data sets, and their exit codes.

use std::process::ExitCode;

use anyhow::Context;
use bus::malloc_settings;
use clap::{Parser, Subcommand};
use dataset::LeftOut;
use support::output;

use crate::command;

/// Training and evaluation of the localization.
#[derive(Debug, Parser)]
#[command(
    name = "agent",
    bin_name = "agent",
    version,
    after_help = "Exit codes: 0 done, 1 failed, 2 bad usage or input, 3 data could not be used and were left out."
)]
pub(crate) struct Cli {
    #[command(subcommand)]
    command: Command,
}

#[derive(Debug, Subcommand)]
enum Command {
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

/// Runs a subcommand and prints the chain of causes where it failed.
pub(crate) fn run(cli: Cli) -> ExitCode {
    let kept = malloc_settings::ensure(&malloc_settings::KEPT_MEMORY).context("this program again");
    let outcome = kept.and_then(|()| match cli.command {
        Command::Eval(args) => command::eval::run(&args),
        Command::Localize(args) => command::localize::run(&args),
        Command::Train(args) => command::train::run(&args).map(|()| Outcome::Done),
    });
    match outcome {
        Ok(Outcome::Done) => ExitCode::SUCCESS,
        Ok(Outcome::DataLost) => ExitCode::from(3),
        Err(error) => {
            output::note(format_args!("error: {error:#}"));
            if error.is::<BadInput>() { ExitCode::from(2) } else { ExitCode::FAILURE }
        }
    }
}
