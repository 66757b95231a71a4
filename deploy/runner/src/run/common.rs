//! Options, result and beginning of a run, on the wall clock and in simulation time alike.

use std::path::PathBuf;

use bus::{present, process_id};
use deploy::operate::network::{Network, RouterEndpoint};
use deploy::operate::run_folder::{RunFolder, name_of_now};
use deploy::operate::supervise::ProcessSpec;
use deploy::report::RunReport;
use deploy::score::metrics::Metrics;
use deploy::score::scorer_cav;
use protocol::{KeyExpr, Reconciliation, Role, RunId};
use support::output;

use crate::fleet::{Fleet, ticks_without_ego, unused_weights};
use crate::run::RunError;

/// Settings of a run beside its scenario.
#[derive(Debug, Clone)]
pub struct RunOptions {
    /// Folder of the run folders.
    pub runs: PathBuf,
    /// Folder of the programs `agent`, `ego-fuser` and `sim-replay`.
    pub programs: PathBuf,
    /// First part of the name of an unnamed run.
    pub prefix: &'static str,
}

/// Result of a run.
#[derive(Debug)]
pub struct RunResult {
    /// Folder of the run.
    pub folder: RunFolder,
    /// Metrics of the run.
    pub metrics: Metrics,
    /// Message accounting: the discrepancies between senders and receivers.
    pub balance: Reconciliation,
    /// Number of ticks for which the ego published nothing.
    pub missed: u64,
    /// True if the run was interrupted before its end.
    pub interrupted: bool,
    /// Processes that did not end in time and were killed.
    pub killed: Vec<String>,
    /// Files of the run that could not be written, with the reason (for example a full disk).
    pub unwritten: Vec<String>,
    /// Processes that failed in their task, with the reason.
    pub failures: Vec<String>,
    /// Changes that would let the fleet answer more ticks; `None` in simulation time, where it answers all.
    pub remedies: Option<String>,
    /// Pace, stages, resources, and observed causes of lost messages.
    pub report: RunReport,
    /// Picture of one fused frame, if one could be drawn.
    pub picture: Option<PathBuf>,
}

/// Computes a run in a folder of its own, which is removed if the run is refused.
pub(super) fn in_folder(
    fleet: &Fleet,
    options: &RunOptions,
    go: impl FnOnce(&RunId, &RunFolder) -> Result<RunResult, RunError>,
) -> Result<RunResult, RunError> {
    let unused = unused_weights(&fleet.scenario, &fleet.ego);
    let without_ego = ticks_without_ego(&fleet.recorded, &fleet.ego, &fleet.scenario.scene);
    unused.into_iter().chain(without_ego).for_each(output::note);
    let named = fleet.scenario.run.clone();
    let run = named.unwrap_or_else(|| name_of_now(options.prefix));
    let folder = RunFolder::create(&options.runs, &run)?;
    let result = go(&run, &folder);
    // After a failure in the run the folder stays: it holds the logs.
    if result.as_ref().is_err_and(RunError::is_refusal) {
        folder.remove();
    }
    result
}

/// Checks that none of the processes to start, nor a scorer, is already present on a shared router.
///
/// # Errors
/// [`RunError::Live`] names those present; [`RunError::Network`] when the router does not answer.
pub(super) fn check_free(
    place: &RouterEndpoint,
    network: &Network,
    run: &RunId,
    specs: &[ProcessSpec],
) -> Result<(), RunError> {
    // A router of its own is new, so nobody can be present on it.
    if network.connect.is_none() {
        return Ok(());
    }
    let scorer = process_id(Role::Scorer, &scorer_cav());
    let mut processes = present(&place.session, KeyExpr::everyone_alive(run).as_str())?;
    processes.retain(|process| {
        *process == scorer || specs.iter().any(|spec| spec.name == process.as_str())
    });
    if processes.is_empty() {
        return Ok(());
    }
    Err(RunError::Live {
        run: run.clone(),
        router: place.endpoint.to_string(),
        processes: processes.into_iter().collect(),
    })
}
