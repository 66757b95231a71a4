//! One file per subcommand: its arguments, and the call into the library.

mod keys;
mod report;
mod ros2;
mod router;
mod status;
mod view;
mod watched_run;

use std::path::Path;

use anyhow::Context;
use bus::{BusOptions, Endpoint, Identity, malloc_settings};
use protocol::{CavId, Principal, Role, RunId};
use support::cli::Outcome;
use support::sibling_program::Sibling;

use crate::operate::security::credentials;

/// Subcommands that compute networks; listed first.
pub(crate) const RUNNER: Sibling = Sibling {
    program: "v2vloc-runner",
    subcommands: &[
        (
            "demo",
            "Generate a scene if there is none, run a fleet on it and print the result",
        ),
        (
            "up",
            "Start a fleet: processes, scene, models, network; Ctrl-C ends it",
        ),
        (
            "eval",
            "Evaluate methods on recorded scenes without a network: AP, pose errors, bytes",
        ),
        (
            "bench",
            "Measure what a frame costs on this machine: every stage in milliseconds and in units, which compare machines",
        ),
        (
            "sweep",
            "Run a grid of experiments in simulation time: one CSV, charts, a report",
        ),
        (
            "schema",
            "Print the JSON schema of a kind of file, for editors: the files in deploy/scenarios and deploy/experiments \
             are its output",
        ),
    ],
};

/// Subcommands of `v2vloc` that compute no network, listed behind those that do.
#[derive(Debug, clap::Subcommand)]
pub(crate) enum Command {
    /// Print stages, pace, latency, CPU, memory and bytes of a run that has ended.
    #[command(display_order = 20)]
    Report(report::Arguments),
    /// Show a run in a browser, live while it goes on, else from its recording (`v2vloc up --record`; a folder or a
    /// recording.mcap): the scene from above, the links, the latency of each stage.
    #[command(display_order = 21)]
    View(view::Arguments),
    /// Report the state of a run: every process present, ready and answering? Exit code 1 if not.
    #[command(display_order = 22)]
    Status(status::Arguments),
    /// Run the router of a fleet whose processes are on several hosts, or write the configuration of a zenohd in its
    /// place.
    #[command(display_order = 23)]
    Router(router::Arguments),
    /// Make a test authority and certificates for the processes of a fleet.
    #[command(display_order = 24)]
    Keys(keys::Arguments),
    /// Connect a run with a ROS 2 network through rmw_zenoh: poses, odometry, detections, tracks, clouds, transforms and
    /// diagnoses; and LiDARs of the network with the agents of the run.
    #[command(display_order = 25)]
    Ros2(Box<ros2::Arguments>),
}

impl Command {
    /// Runs the subcommand.
    pub(crate) fn run(self) -> anyhow::Result<Outcome> {
        use malloc_settings::{KEPT_MEMORY, ROUTER_THREADS};
        let mut settings = KEPT_MEMORY.to_vec();
        settings.extend(matches!(self, Self::Router(_)).then_some(ROUTER_THREADS));
        // Executes this program again where a setting is missing, so nothing may run before it.
        malloc_settings::ensure(&settings).context("this program again")?;
        match self {
            Self::Report(arguments) => arguments.run(),
            Self::View(arguments) => arguments.run(),
            Self::Status(arguments) => arguments.run(),
            Self::Router(arguments) => arguments.run(),
            Self::Keys(arguments) => arguments.run(),
            Self::Ros2(arguments) => arguments.run(),
        }
    }
}

/// Reads the agent of a robot's own node. The node of a whole run is named as its role, and may publish for every agent.
fn robot(text: &str) -> Result<CavId, String> {
    let cav = CavId::new(text).map_err(|error| error.to_string())?;
    if Principal::new(Role::Ros2, &cav) == Principal::of_role(Role::Ros2) {
        return Err(format!("{text} is the name of the node of a whole run"));
    }
    Ok(cav)
}

/// Identity of a process in a run and options of a client of its router; `keys` where the run has security.
fn client(
    run: &RunId,
    process: &Principal,
    router: &Endpoint,
    keys: Option<&Path>,
) -> anyhow::Result<(Identity, BusOptions)> {
    let identity = Identity::new(run.clone(), process.name(), process.cav.clone());
    let mut options = BusOptions::client(router.clone());
    if let Some(folder) = keys {
        options = options.with_credentials(credentials(folder, identity.process.as_str())?);
    }
    Ok((identity, options))
}
