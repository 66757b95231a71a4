//! One file per subcommand: its arguments, and the call into the library.

mod capacity;
mod demo;
mod eval;
mod keys;
mod report;
mod ros2;
mod router;
mod schema;
mod status;
mod sweep;
mod up;
mod view;

use std::error::Error;
use std::path::{Path, PathBuf};

use anyhow::Context;
use bus::{Bus, BusError, BusOptions, Credentials, Endpoint, Identity, malloc_settings, process_id};
use dataset::LeftOut;
use deploy::experiment::evaluation::EvaluationError;
use deploy::experiment::sweep::SweepError;
use deploy::experiment::table::TableError;
use deploy::operate::RunError;
use deploy::operate::fleet::FleetError;
use deploy::scenario::ScenarioError;
use protocol::{CavId, Role, RunId};
use support::cli::Outcome;
use support::output;

/// Subcommands of `v2vloc`.
#[derive(Debug, clap::Subcommand)]
pub(crate) enum Command {
    /// Estimate the pace of a run, in a process of its own.
    #[command(hide = true)]
    Capacity(capacity::Arguments),
    /// Generate a scene if there is none, run a fleet on it and print the result.
    Demo(Box<demo::Arguments>),
    /// Evaluate methods on recorded scenes without a network: AP, pose errors, bytes.
    Eval(Box<eval::Arguments>),
    /// Make a test authority and certificates for the processes of a fleet.
    Keys(keys::Arguments),
    /// Connect a run with a ROS 2 network through rmw_zenoh: poses, odometry, detections, clouds, transforms and
    /// diagnoses; and LiDARs of the network with the agents of the run.
    Ros2(Box<ros2::Arguments>),
    /// Run the router of a fleet whose processes are on several hosts, or write the configuration of a zenohd in its
    /// place.
    Router(router::Arguments),
    /// Print the JSON schema of a kind of file, for editors: the files in deploy/scenarios and deploy/experiments are
    /// its output.
    Schema(schema::Arguments),
    /// Print stages, pace, latency, CPU, memory and bytes of a run that has ended.
    Report(report::Arguments),
    /// Run a grid of experiments in simulation time: one CSV, charts, a report.
    Sweep(sweep::Arguments),
    /// Report the state of a run: every process present, ready and answering? Exit code 1 if not.
    Status(status::Arguments),
    /// Start a fleet: processes, scene, models, network; Ctrl-C ends it.
    Up(Box<up::Arguments>),
    /// Show a run in a browser: the scene from above, the links, the latency of each stage.
    View(view::Arguments),
}

impl Command {
    /// Runs the subcommand.
    pub(crate) fn run(self) -> anyhow::Result<Outcome> {
        let settings = [malloc_settings::KEPT_MEMORY.as_slice(), &[malloc_settings::ROUTER_THREADS]].concat();
        malloc_settings::ensure(&settings).context("this program again")?;
        match self {
            Self::Capacity(arguments) => arguments.run(),
            Self::Demo(arguments) => arguments.run(),
            Self::Eval(arguments) => arguments.run(),
            Self::Status(arguments) => arguments.run(),
            Self::Keys(arguments) => arguments.run(),
            Self::Report(arguments) => arguments.run(),
            Self::Ros2(arguments) => arguments.run(),
            Self::Router(arguments) => arguments.run(),
            Self::Schema(arguments) => arguments.run(),
            Self::Sweep(arguments) => arguments.run(),
            Self::Up(arguments) => arguments.run(),
            Self::View(arguments) => arguments.run(),
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
    cause.is::<ScenarioError>()
        || cause.is::<FleetError>()
        || cause.is::<EvaluationError>()
        || cause.is::<TableError>()
        || BusError::is_behind(cause)
        || cause.downcast_ref::<SweepError>().is_some_and(SweepError::is_bad_input)
        || cause.downcast_ref::<RunError>().is_some_and(RunError::is_bad_input)
}

/// A connection to the router of a run as a viewer; `keys` where the run has security.
fn viewer_bus(run: &RunId, router: &Endpoint, keys: Option<&Path>) -> anyhow::Result<Bus> {
    let cav = CavId::new("viewer")?;
    let identity = Identity { run: run.clone(), process: process_id(Role::Viewer, &cav), cav };
    let mut options = BusOptions::client(router.clone());
    if let Some(folder) = keys {
        let credentials = Credentials::read(folder)?;
        credentials.check_name(identity.process.as_str())?;
        options = options.with_credentials(credentials);
    }
    Ok(Bus::join(&options, identity)?)
}

/// Folder of the programs: they are built and installed together.
pub(crate) fn programs() -> anyhow::Result<PathBuf> {
    let own = std::env::current_exe().context("folder of this program")?;
    Ok(own.parent().context("this program is in no folder")?.to_path_buf())
}
