//! Command line of the vehicle's process.

use std::io;
use std::process::ExitCode;

use anyhow::Context;
use bus::BusError;
use bus::malloc_settings;
use clap::{Parser, Subcommand};
use support::cli::{Outcome, exit_code};
use support::sibling_program::Forwarded;

use crate::command;

/// Program that carries out the offline subcommands.
const OFFLINE: &str = "agent-offline";

/// Agent of one connected vehicle: localizes each LiDAR sweep, computes its BEV features and publishes both.
#[derive(Debug, Parser)]
#[command(
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
    Run(Box<command::run::Args>),
    /// Localize recorded sweeps and compare with their true poses
    Eval(Forwarded),
    /// Localize recorded sweeps and write their poses to a table
    Localize(Forwarded),
    /// Find the pose of single point clouds
    Locate(Forwarded),
    /// Make a head for a place from drives through it
    Map(Forwarded),
    /// Prepare a scene head for 8-bit inference
    Quantise(Forwarded),
    /// Train the networks of the localization
    Train(Forwarded),
}

impl Command {
    fn run(self) -> anyhow::Result<()> {
        let offline = |forwarded: Forwarded, name| -> io::Result<()> { Err(forwarded.exec(OFFLINE, name)) };
        match self {
            Self::Run(args) => {
                malloc_settings::ensure(&malloc_settings::KEPT_MEMORY).context("cannot execute this program again")?;
                command::run::run(*args)
            }
            Self::Eval(forwarded) => Ok(offline(forwarded, "eval")?),
            Self::Localize(forwarded) => Ok(offline(forwarded, "localize")?),
            Self::Locate(forwarded) => Ok(offline(forwarded, "locate")?),
            Self::Map(forwarded) => Ok(offline(forwarded, "map")?),
            Self::Quantise(forwarded) => Ok(offline(forwarded, "quantise")?),
            Self::Train(forwarded) => Ok(offline(forwarded, "train")?),
        }
    }
}

/// Runs a subcommand.
pub(crate) fn run(cli: Cli) -> ExitCode {
    exit_code(cli.command.run().map(|()| Outcome::Done), BusError::is_behind)
}
