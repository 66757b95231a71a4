//! Command line of the agent's offline subcommands, which read data sets.

use std::process::ExitCode;

use anyhow::Context;
use bus::malloc_settings;
use clap::{Parser, Subcommand};
use support::cli::{Outcome, exit_code};

use crate::command;

/// Training and evaluation of the localization.
#[derive(Debug, Parser)]
#[command(
    name = "agent",
    bin_name = "agent",
    version,
    after_help = "Exit codes: 0 done, 1 failed, 2 bad usage or input, 3 data could not be used and were left out, 130 \
                  a training was stopped by Ctrl-C."
)]
pub(crate) struct Cli {
    #[command(subcommand)]
    command: Command,
}

#[derive(Debug, Subcommand)]
enum Command {
    Eval(command::eval::Args),
    Localize(command::localize::Args),
    Locate(command::locate::Args),
    Map(command::map::Args),
    Quantise(command::quantise::Args),
    Train(command::train::Args),
}

/// Runs a subcommand.
pub(crate) fn run(cli: Cli) -> ExitCode {
    let kept = match cli.command {
        // Kept memory pays off over many frames; a second start costs as much time as a cloud takes.
        Command::Locate(_) => Ok(()),
        _ => malloc_settings::ensure(&malloc_settings::KEPT_MEMORY)
            .context("cannot execute this program again"),
    };
    let outcome = kept.and_then(|()| match cli.command {
        Command::Eval(args) => command::eval::run(&args),
        Command::Localize(args) => command::localize::run(&args),
        Command::Locate(args) => command::locate::run(&args),
        Command::Map(args) => command::map::run(&args),
        Command::Quantise(args) => command::quantise::run(&args),
        Command::Train(args) => command::train::run(&args).map(|()| Outcome::Done),
    });
    exit_code(outcome, |_| false)
}
