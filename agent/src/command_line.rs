//! Command line of the vehicle's process.

use std::process::ExitCode;

use anyhow::Context;
use bus::BusError;
use bus::malloc_settings;
use clap::{Parser, Subcommand};
use support::cli::exit_code;
use support::command_line::parse_beside;
use support::sibling_program::Sibling;

use crate::command;

/// Subcommands that read data sets.
const OFFLINE: Sibling = Sibling {
    program: "agent-offline",
    subcommands: &[
        ("cover", "State in a scene head where its drives were"),
        (
            "eval",
            "Localize recorded sweeps and compare with their true poses",
        ),
        (
            "localize",
            "Localize recorded sweeps and write their poses to a table",
        ),
        ("locate", "Find the pose of single point clouds"),
        ("map", "Make a head for a place from drives through it"),
        ("quantise", "Prepare a scene head for 8-bit inference"),
        ("train", "Train the networks of the localization"),
    ],
};

/// Agent of one connected vehicle: localizes each LiDAR sweep, computes its BEV features and publishes both.
#[derive(Debug, Parser)]
#[command(
    version,
    after_help = "Exit codes: 0 done, 1 failed, 2 bad usage or input, 3 data could not be used and were left out, 130 \
                  a training was stopped by Ctrl-C."
)]
pub struct CommandLine {
    #[command(subcommand)]
    command: Command,
}

#[derive(Debug, Subcommand)]
enum Command {
    Run(Box<command::run::Args>),
    ReplayInputs(command::replay_inputs::Arguments),
}

/// Runs the subcommand on the command line.
pub fn main() -> ExitCode {
    let command_line: CommandLine = parse_beside(&OFFLINE);
    let outcome = match command_line.command {
        // It may execute the program again, so it comes before everything else.
        Command::Run(args) => malloc_settings::ensure(&malloc_settings::KEPT_MEMORY)
            .context("cannot execute this program again")
            .and_then(|()| command::run::run(*args)),
        Command::ReplayInputs(arguments) => arguments.run(),
    };
    exit_code(outcome, BusError::is_behind)
}
