//! Command line of the agent's offline subcommands, which read data sets.

#![warn(clippy::print_stdout, clippy::print_stderr)]

mod command;

use std::process::ExitCode;

use agent::command_line::CommandLine;
use anyhow::Context;
use bus::malloc_settings;
use clap::{Parser, Subcommand};
use support::cli::{Outcome, exit_code};
use terminal::command_line::parse_behind;

/// Training and evaluation of the localization.
#[derive(Debug, Parser)]
#[command(
    name = "agent",
    bin_name = "agent",
    version,
    after_help = "Exit codes: 0 done, 1 failed, 2 bad usage or input, 3 data could not be used and were left out, 130 \
                  a training was stopped by Ctrl-C."
)]
struct Cli {
    #[command(subcommand)]
    command: Command,
}

#[derive(Debug, Subcommand)]
enum Command {
    Cover(command::cover::Args),
    Eval(command::eval::Args),
    Localize(command::localize::Args),
    Locate(command::locate::Args),
    Map(command::map::Args),
    Quantise(command::quantise::Args),
    Train(command::train::Args),
}

fn main() -> ExitCode {
    let command = parse_behind::<Cli, CommandLine>().command;
    let kept = match command {
        // Kept memory pays off over many frames; a second start costs as much time as a cloud takes.
        Command::Locate(_) => Ok(()),
        _ => malloc_settings::ensure(&malloc_settings::KEPT_MEMORY)
            .context("cannot execute this program again"),
    };
    let outcome = kept.and_then(|()| match command {
        Command::Cover(args) => command::cover::run(&args),
        Command::Eval(args) => command::eval::run(&args),
        Command::Localize(args) => command::localize::run(&args),
        Command::Locate(args) => command::locate::run(&args),
        Command::Map(args) => command::map::run(&args),
        Command::Quantise(args) => command::quantise::run(&args),
        Command::Train(args) => command::train::run(&args).map(|()| Outcome::Done),
    });
    exit_code(outcome, |_| false)
}
