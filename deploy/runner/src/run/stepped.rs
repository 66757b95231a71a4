//! `clock: stepped`: a scenario in simulation time, in this process alone, or with one process per agent.
//!
//! The run folder is that of a live run. Only `scenario.yaml` and `log/` depend on machine, load, time of day and
//! number of processes.

use std::collections::BTreeMap;

use dataset::findings;
use deploy::operate::run_folder::{RunFolder, RunFolderError, frames_csv};
use deploy::report::{self, RunReport};
use deploy::score::FrameScores;
use ego_fuser_offline::evaluation::{EvaluatedFrame, Evaluator};
use protocol::RunId;
use support::file_error::AtFile;
use support::provenance::Provenance;
use terminal::progress;

use crate::evaluated_frame::{judge, metrics};
use crate::fleet::Fleet;
use crate::frame_lines::FrameLines;
use crate::run::agent_pool::AgentProcesses;
use crate::run::common::{RunOptions, RunResult, in_folder};
use crate::run::ledger_report::LedgerReport;
use crate::run::{Result, RunError};
use crate::scenario::Scenario;

/// Runs a scenario in simulation time to its end.
///
/// # Errors
/// [`RunError`] when no fleet can be built from the scenario, or a frame cannot be read or computed.
pub fn run_scenario(scenario: &Scenario, options: &RunOptions) -> Result<RunResult> {
    let mut fleet = Fleet::plan(scenario).map_err(RunError::Fleet)?;
    findings::note(&fleet.findings);
    fleet.scenario.models.threads.apply();
    let mut evaluator = Evaluator::new(fleet.setup().map_err(RunError::Fleet)?)?;
    let stepped = fleet.scenario.stepped.get_or_insert_default();
    // Measured once before the run, so that all frames take the same times.
    let compute = match stepped.compute {
        Some(compute) => compute,
        None => evaluator.measure(&fleet.recorded)?,
    };
    // Written into scenario.yaml with the rest, so that the run can be repeated with these times.
    stepped.compute = Some(compute);
    evaluator.setup.compute = compute;
    let in_processes = stepped.processes;
    in_folder(&fleet, options, |run, folder| {
        let mut running = None;
        if in_processes {
            let (processes, remote) =
                AgentProcesses::start(&fleet, run, folder, &options.programs)?;
            evaluator.set_processes(Some(remote));
            running = Some(processes);
        }
        let scores = play(&fleet, &mut evaluator, folder)?;
        evaluator.set_processes(None);
        let killed = running.map(AgentProcesses::end).unwrap_or_default();
        let result = write(&fleet, &evaluator, &scores, (run, folder.clone()), options)?;
        Ok(RunResult { killed, ..result })
    })
}

/// Computes all ticks; detections are appended to their file.
fn play(fleet: &Fleet, evaluator: &mut Evaluator, folder: &RunFolder) -> Result<FrameScores> {
    let (rule, map_values) = (fleet.applied_protocol().ground_truth, fleet.map_values());
    let mut scores = FrameScores::new(fleet.ego.clone(), rule, map_values);
    let lines = FrameLines::create(folder.path()).at(folder.path());
    let mut lines = lines.map_err(RunFolderError::Write)?;
    let is_timed = evaluator.setup.is_timed();
    let bar = progress::bar(fleet.ticks.unwrap_or(0), "ticks");
    let _ = evaluator.run(&fleet.recorded, &mut |frame: EvaluatedFrame| {
        bar.inc(1);
        let written = lines.add(None, &frame);
        judge(&mut scores, frame, is_timed);
        written
    })?;
    bar.finish_and_clear();
    let finished = lines.finish().at(folder.path());
    finished.map_err(RunFolderError::Write)?;
    Ok(scores)
}

fn write(
    fleet: &Fleet,
    evaluator: &Evaluator,
    scores: &FrameScores,
    (run, folder): (&RunId, RunFolder),
    options: &RunOptions,
) -> Result<RunResult> {
    let ledger = &evaluator.ledger;
    let balance = ledger.balance();
    let (poses, seconds) = (fleet.pose_source(), scores.seconds());
    let mut metrics = metrics(scores, evaluator, "stepped", poses, seconds);
    metrics.left_out.merge(&fleet.left_out);
    let provenance = fleet.provenance(&options.programs);
    metrics.provenance = provenance.clone().map(Provenance::with_command);
    folder.write_json(deploy::score::metrics::FILE, &metrics)?;
    // Times of processes on the wall clock say nothing here, so none are reported.
    let report = RunReport::new(run, &metrics, scores.records(), &[], None);
    folder.write_json(report::FILE, &report)?;
    let frames = frames_csv(scores.records(), &BTreeMap::new(), None);
    folder.write("frames.csv", &frames)?;
    let accounts = LedgerReport {
        balances: balance.is_exact(),
        balance: balance.clone(),
        total: ledger.delivered(),
        sum: ledger.clone(),
        ..LedgerReport::default()
    };
    folder.write_json("ledger.json", &accounts)?;
    let resolved = Scenario {
        provenance,
        ..fleet.scenario.clone()
    };
    folder.write("scenario.yaml", &resolved.to_yaml())?;
    let picture = crate::run::demo::draw(fleet, scores, &folder.file("frame.png"));
    Ok(RunResult {
        folder,
        metrics,
        balance,
        missed: scores.missed(),
        interrupted: false,
        killed: Vec::new(),
        unwritten: Vec::new(),
        failures: Vec::new(),
        remedies: None,
        report,
        picture,
    })
}
