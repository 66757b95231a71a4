//! One file per subcommand: its arguments, and the call into the library.

mod bench;
mod capacity;
mod demo;
mod eval;
mod slices;
mod sweep;
mod up;

use std::error::Error;
use std::path::PathBuf;

use anyhow::Context;
use bus::{BusError, malloc_settings};
use dataset::LeftOut;
use runner::run::RunError;
use runner::schema::SchemaOf;
use support::cli::Outcome;
use support::output;

/// Subcommands of `v2vloc` that compute networks.
#[derive(Debug, clap::Subcommand)]
pub(crate) enum Command {
    /// Measure what a frame costs on this machine: every stage in milliseconds and in units, which compare machines.
    Bench(bench::Arguments),
    /// Measure what the pace of a run is estimated from, in a process of its own.
    #[command(hide = true)]
    Capacity(capacity::Arguments),
    /// Generate a scene if there is none, run a fleet on it and print the result.
    Demo(Box<demo::Arguments>),
    /// Start a fleet: processes, scene, models, network; Ctrl-C ends it.
    Up(Box<up::Arguments>),
    /// Evaluate methods on recorded scenes without a network: AP, pose errors, bytes.
    Eval(Box<eval::Arguments>),
    /// Run a grid of experiments in simulation time: one CSV, charts, a report.
    Sweep(sweep::Arguments),
    /// Print the JSON schema of a kind of file, for editors: the files in deploy/scenarios and deploy/experiments are
    /// its output.
    Schema {
        /// Kind of file.
        #[arg(value_enum)]
        of: SchemaOf,
    },
}

impl Command {
    /// Runs the subcommand.
    pub(crate) fn run(self) -> anyhow::Result<Outcome> {
        // Executes this program again where a setting is missing, so nothing may run before it.
        malloc_settings::ensure(&malloc_settings::KEPT_MEMORY).context("this program again")?;
        match self {
            Self::Bench(arguments) => arguments.run(),
            Self::Capacity(arguments) => arguments.run(),
            Self::Demo(arguments) => arguments.run(),
            Self::Up(arguments) => arguments.run(),
            Self::Eval(arguments) => arguments.run(),
            Self::Sweep(arguments) => arguments.run(),
            Self::Schema { of } => {
                output::text(of.json())?;
                Ok(Outcome::Done)
            }
        }
    }
}

/// Prints what evaluations left out, each finding once, and the counts of the first incomplete one.
fn left_out<'a>(all: impl Iterator<Item = &'a LeftOut>) -> Outcome {
    let mut sum = LeftOut::default();
    let mut first = None;
    for one in all.filter(|one| **one != LeftOut::default()) {
        sum.merge(one);
        first.get_or_insert(one);
    }
    let outcome = sum.print();
    first.into_iter().for_each(output::note);
    outcome
}

/// True if the cause of an error is a fault of usage or input, and not of the program.
pub(crate) fn is_bad_input(cause: &(dyn Error + 'static)) -> bool {
    let run = cause.downcast_ref::<RunError>();
    BusError::is_behind(cause) || run.is_some_and(RunError::is_bad_input)
}

/// Folder of the programs: they are built and installed together.
pub(crate) fn programs() -> anyhow::Result<PathBuf> {
    let own = std::env::current_exe().context("folder of this program")?;
    let folder = own.parent().context("this program is in no folder")?;
    Ok(folder.to_path_buf())
}
