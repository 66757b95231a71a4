//! Command line: the sub-commands.

use std::process::ExitCode;

use clap::{Parser, Subcommand};

use bus::BusError;
use sim_replay::config::{RecorderConfig, ReplayConfig};
use support::cli::exit_code;

use crate::command::{self, ProcessArgs};

/// Scenes: inspect recorded ones, generate new ones, stream either as live traffic, record a run.
#[derive(Debug, Parser)]
#[command(
    version,
    after_help = "Exit codes: 0 done, 1 failed, 2 bad usage or input, 3 finished but data was lost (convert, stream: frames \
                  that cannot be read; stream: ticks that are not answered; record, recover and export: messages that are \
                  missing; link: messages that never arrive)."
)]
pub(crate) struct Cli {
    #[command(subcommand)]
    command: Command,
}

#[derive(Debug, Subcommand)]
enum Command {
    Convert(command::convert::Args),
    Export(command::export::Args),
    Inspect(command::inspect::Args),
    Link(Box<command::link::Args>),
    /// Write all messages of a run into an MCAP file, which `sim-replay stream` replays and Foxglove opens.
    ///
    /// Ends when the replay does, or on Ctrl-C. A truncated file can be replayed up to its last whole chunk.
    Record(ProcessArgs<RecorderConfig>),
    Recover(command::recover::Args),
    /// Publish a scene as if its vehicles were driving now.
    ///
    /// The clock starts when all expected routes have carried a probe. While it runs, it applies control messages
    /// (`pause`, `resume`, `step`, `seek`, `start` with another rate).
    ///
    /// With a rate above 0 and without lockstep, a newer sweep replaces one that still waits for the network: the
    /// summary counts them. Exit code 3 is for frames that cannot be read and ticks that are not answered.
    Stream(Box<ProcessArgs<ReplayConfig>>),
    Synth(command::synth::Args),
}

/// Runs the selected sub-command.
pub(crate) fn run(cli: Cli) -> ExitCode {
    let outcome = match cli.command {
        Command::Convert(args) => command::convert::run(&args),
        Command::Export(args) => command::export::run(&args),
        Command::Inspect(args) => command::inspect::run(&args),
        Command::Link(args) => command::link::run(*args),
        Command::Record(args) => command::record::run(args),
        Command::Recover(args) => command::recover::run(&args),
        Command::Stream(args) => command::stream::run(*args),
        Command::Synth(args) => command::synth::run(args),
    };
    exit_code(outcome, BusError::is_behind)
}
