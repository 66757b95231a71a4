//! Subcommands that read data sets: one file each, with its arguments and the call into the library.

mod align;
mod alignment_error;
mod eval;
mod train;

use std::io::IsTerminal;
use std::path::PathBuf;
use std::process::ExitCode;

use anyhow::Context;
use bus::BusError;
use bus::malloc_settings;
use dataset::{self, IntensityScale, LeftOut, OpenOptions, Scenario};
use indicatif::{ProgressBar, ProgressStyle};
use support::output;

/// Subcommands of `ego-fuser` that read data sets.
#[derive(Debug, clap::Subcommand)]
pub(crate) enum Command {
    /// Compare ways to align two vehicles without GNSS.
    Align(Box<align::Arguments>),
    /// Measure AP on recorded scenes.
    Eval(eval::Arguments),
    /// Measure what a method's own alignment leaves of offsets that are put on true poses.
    Residual(alignment_error::Arguments),
    /// Train a method on scenes.
    Train(Box<train::Arguments>),
}

impl Command {
    /// Does what was asked.
    pub(crate) fn run(self) -> anyhow::Result<()> {
        malloc_settings::ensure(&malloc_settings::KEPT_MEMORY).context("this program again")?;
        match self {
            Self::Align(arguments) => arguments.run(),
            Self::Eval(arguments) => arguments.run(),
            Self::Residual(arguments) => arguments.run(),
            Self::Train(arguments) => arguments.run(),
        }
    }
}

/// Usage or input at fault, and not the program: exit code 2.
#[derive(Debug, thiserror::Error)]
#[error("{0}")]
pub(crate) struct BadInput(pub(crate) String);

/// The numbers are printed, but data were left out: exit code 3.
#[derive(Debug, thiserror::Error)]
#[error("{0}")]
pub(crate) struct DataLost(LeftOut);

/// Names what was left out; an error where data were lost.
fn check_left_out(left_out: &LeftOut) -> Result<(), DataLost> {
    left_out.problems().for_each(|problem| output::note(format_args!("left out: {}", problem.message)));
    if left_out.is_nothing() { Ok(()) } else { Err(DataLost(left_out.clone())) }
}

/// Exit code of a command that did not end well: 2 for bad usage or input, 3 where data were left out, 1 otherwise.
pub(crate) fn exit_code(error: &anyhow::Error) -> ExitCode {
    if error.is::<DataLost>() {
        return ExitCode::from(3);
    }
    let is_bad_input = error.chain().any(|cause| cause.is::<BadInput>()) || BusError::is_behind(error.as_ref());
    if is_bad_input { ExitCode::from(2) } else { ExitCode::FAILURE }
}

/// All scenarios of some datasets.
fn scenarios(folders: &[PathBuf], intensity_scale: IntensityScale) -> anyhow::Result<Vec<Scenario>> {
    let options = OpenOptions { intensity_scale, ..OpenOptions::default() };
    let mut scenarios = Vec::new();
    for folder in folders {
        scenarios.extend(dataset::open_with(folder, &options).map_err(|error| BadInput(error.to_string()))?.scenarios);
    }
    Ok(scenarios)
}

/// A bar where somebody watches; `what` stands before it.
fn progress(what: &'static str, total: usize) -> ProgressBar {
    let bar = if std::io::stderr().is_terminal() { ProgressBar::new(total as u64) } else { ProgressBar::hidden() };
    if let Ok(style) = ProgressStyle::with_template("{msg} {wide_bar} {pos}/{len} eta {eta}") {
        bar.set_style(style);
    }
    bar.with_message(what)
}
