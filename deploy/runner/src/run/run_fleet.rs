//! One run from beginning to end: plan, start, watch, end, score, write.

use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;
use std::sync::mpsc::{Receiver, Sender, channel};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use bus::shutdown::Stop;
use bus::{MetricsPeer, ROUTER};
use dataset::findings;
use deploy::operate::progress::Display;
use deploy::operate::router_report::{RefusalCount, RouterReport};
use deploy::operate::run_folder::{RunFolder, SWEEP_LOG, frames_csv};
use deploy::operate::status::Phase;
use deploy::operate::status_reporter::{Ending, StatusReporter};
use deploy::operate::supervise::{ProcessEvent, ProcessEventKind, ProcessSpec, Supervisor};
use deploy::operate::timeouts::Timeouts;
use deploy::operate::{RECORDER, REPLAY};
use deploy::report::{self, Capacity, RunReport};
use deploy::score::metrics::Metrics;
use deploy::score::{
    FrameScores, ProcessStats, Progress, Scored, ScorerNode, TRACKS, offline_intervals,
};
use ego_fuser_offline::evaluation::add_unplaced_tick;
use protocol::{Ledger, ProcessId, ProcessUsage, Role, RunId};
use support::provenance::Provenance;
use support::{atomic_file, output};

use crate::fleet::{Fleet, SessionContext};
use crate::run::capacity::{BUDGET, estimate, remedies};
use crate::run::common::{check_free, in_folder};
use crate::run::ledger_report::LedgerReport;
use crate::run::router_process::Router;
use crate::run::{Result, RunError, stepped};
use crate::scenario::{Clock, Scenario};

pub use crate::run::common::{RunOptions, RunResult};

/// Update interval of the display.
const BEAT: Duration = Duration::from_millis(100);
/// Fraction of the time for ending after which the replay must have ended.
const REPLAY_SHARE: f64 = 0.25;
/// Fraction of the time for ending after which the last results must have arrived.
const DRAIN_SHARE: f64 = 0.5;

/// For writing the index of a recording, after all others have ended.
const RECORDER_SHARE: Duration = Duration::from_millis(800);

/// Files of results and of ground truth, a line each.
const LINES: [&str; 3] = ["detections.jsonl", "truth.jsonl", TRACKS];

/// Runs a scenario to its end, or until Ctrl-C.
///
/// # Errors
/// [`RunError`] when the run cannot start, or a process stays down.
pub fn run_scenario(scenario: &Scenario, options: &RunOptions) -> Result<RunResult> {
    if scenario.clock == Clock::Stepped {
        return stepped::run_scenario(scenario, options);
    }
    let fleet = Fleet::plan(scenario).map_err(RunError::Fleet)?;
    findings::note(&fleet.findings);
    in_folder(&fleet, options, |run, folder| {
        go(&fleet, options, run, folder)
    })
}

/// Prints what this machine can carry. A run whose pace cannot be estimated goes on without.
fn announce_capacity(fleet: &Fleet, programs: &Path) -> Option<Capacity> {
    let capacity = estimate(fleet, programs, BUDGET).unwrap_or_else(|error| {
        tracing::warn!("the pace of the run cannot be estimated: {error}");
        None
    })?;
    output::note(format_args!("this machine: {capacity}"));
    if !capacity.keeps_up() {
        let remedies = remedies(fleet, Some(&capacity));
        output::note(format_args!("it will not keep up; {remedies} would help"));
    }
    Some(capacity)
}

/// Runs a fleet under the given run name in the given folder.
fn go(fleet: &Fleet, options: &RunOptions, run: &RunId, folder: &RunFolder) -> Result<RunResult> {
    let stop = Stop::new();
    stop.on_signals().map_err(RunError::Signals)?;
    // Before anything else of the run takes the cores.
    let capacity = announce_capacity(fleet, &options.programs);
    // Hashes programs, weights and scene during the run.
    let (hashed, programs) = (fleet.clone(), options.programs.clone());
    let fingerprint = std::thread::spawn(move || hashed.provenance(&programs));

    let keys = fleet.keys(folder)?;
    let mut context = SessionContext {
        run,
        endpoint: fleet.scenario.network.endpoint(keys.is_some())?,
        keys: keys.as_ref(),
        programs: &options.programs,
        folder,
    };
    let (events, process_events) = channel();
    let network = &fleet.scenario.network;
    let restarts = fleet.scenario.timeouts.restarts;
    let router = Router::start(network, &mut context, restarts, &events, &stop)?;
    let specs = fleet.processes(&context)?;
    check_free(&router.place, &fleet.scenario.network, run, &specs)?;
    let scorer = start_scorer(fleet, &context, &router, &specs)?;
    // Not returned at once on an error: scorer and router have to be ended first.
    let events = (&events, &process_events);
    let watched = watch(fleet, &context, specs, &router, events, &scorer, &stop);
    let mut scored = scorer.finish();
    let mut refused = Vec::new();
    let ended = router.end();
    let mut watched = watched?;
    if let Some((report, killed)) = ended {
        scored.stats.push(router_stats(&report));
        refused = report.refused;
        watched.killed.extend(killed.then(|| ROUTER.to_owned()));
    }

    // Also after a failure: the folder gets what was computed until then.
    let result = write(
        fleet,
        (run, folder.clone()),
        (scored, refused),
        &watched,
        fingerprint,
        capacity,
    );
    match watched.ending {
        Ending::Over | Ending::Asked => Ok(result),
        Ending::Failed { process, how } => {
            let log = result.folder.log_of(&process);
            Err(RunError::Process { process, how, log })
        }
    }
}

/// Starts the scorer before any process, so that it misses none of their messages.
fn start_scorer(
    fleet: &Fleet,
    context: &SessionContext<'_>,
    router: &Router,
    specs: &[ProcessSpec],
) -> Result<ScorerNode> {
    let (ego, agents) = (&fleet.ego, &fleet.agents);
    let rule = fleet.applied_protocol().ground_truth;
    let scores = FrameScores::new(ego.clone(), rule, fleet.map_values());
    let [detections, truth, tracks] = LINES.map(|name| context.folder.file(name));
    let tracks = fleet.scenario.ego.tracks.then_some(tracks);
    let (session, lines) = (router.place.session.clone(), [detections, truth]);
    let mut scorer = ScorerNode::start(session, context.run, agents, ego, scores, lines, tracks)?;
    if let Some(address) = fleet.scenario.network.metrics {
        let peers = specs.iter().filter_map(|spec| {
            Some(MetricsPeer {
                process: spec.name.clone(),
                address: spec.metrics?,
            })
        });
        scorer.serve_metrics(address, peers.collect())?;
    }
    Ok(scorer)
}

/// The router publishes no messages and no reports; its start, which is short, counts as playing.
fn router_stats(report: &RouterReport) -> ProcessStats {
    ProcessStats {
        process: ProcessId::new(ROUTER).expect("lower-case letters"),
        ledger: Ledger::default(),
        stages: Vec::new(),
        usage: ProcessUsage {
            cpu_s: report.cpu_s,
            peak_resident_bytes: report.peak_resident_bytes,
            ..ProcessUsage::default()
        },
        usage_before: ProcessUsage::default(),
        traffic: Vec::new(),
    }
}

/// Observations of the supervisor during a run.
struct Watched {
    ending: Ending,
    /// Processes that had to be killed at the end.
    killed: Vec<String>,
    /// Processes that were offline for some time.
    offline: BTreeSet<String>,
    /// Processes that failed in their task, with the reason.
    failures: Vec<String>,
    /// Observed causes of lost messages.
    causes: Vec<String>,
}

/// Arrival time of each sweep at the ego's agent, by capture time. An agent on another host writes none.
fn sweep_arrivals(log: &Path) -> BTreeMap<u64, u64> {
    support::sweep_log::read(log).unwrap_or_else(|error| {
        if error.kind() != std::io::ErrorKind::NotFound {
            let log = log.display();
            tracing::warn!("{log}: {error}; frames.csv lacks the arrival times of the sweeps");
        }
        BTreeMap::new()
    })
}

/// Starts the processes, follows the run to its end, and ends the processes.
fn watch(
    fleet: &Fleet,
    context: &SessionContext<'_>,
    specs: Vec<ProcessSpec>,
    router: &Router,
    (events, process_events): (&Sender<ProcessEvent>, &Receiver<ProcessEvent>),
    scorer: &ScorerNode,
    stop: &Stop,
) -> Result<Watched> {
    let (run, folder, endpoint) = (context.run, context.folder, &context.endpoint);
    let mut display = Display::new(fleet.ticks);
    if let Some(address) = fleet.scenario.network.metrics {
        let line = format!("metrics of all processes at http://{address}/metrics");
        display.print_line(&line);
    }
    let restarts = fleet.scenario.timeouts.restarts;
    let (count, logs) = (specs.len(), folder.log_dir());
    let logs = logs.display();
    let line = format!("run {run} at {endpoint}: {count} processes, logs in {logs}");
    display.print_line(&line);
    let everyone = specs.iter().map(|spec| spec.name.clone());
    let everyone: Vec<String> = everyone.chain([Role::Scorer.to_string()]).collect();
    // Before the processes start: to open its probe may take seconds, in which nobody would watch them.
    let mut watch = StatusReporter::new(
        &fleet.scenario.timeouts,
        run,
        (
            endpoint,
            router.supervisor().is_some(),
            router.place.probe(run, context.keys),
        ),
        folder,
        fleet.applied_protocol(),
    );
    let mut supervisor = Supervisor::start(specs, &folder.log_dir(), restarts, events)?;
    let processes = (&supervisor, router.supervisor());
    let ending = watch.follow(processes, process_events, scorer, stop, &mut display);
    let mut offline = scorer.absent();
    watch.end();
    watch.write_status(Phase::Ending, &scorer.progress());
    let [replay_until, drain_until, all_until] = deadlines(&fleet.scenario.timeouts, &ending);
    // In the order of the data flow, so that messages on their way still arrive.
    let mut killed = supervisor.end(|name| name == REPLAY, replay_until);
    drain(&supervisor, scorer, drain_until, &mut display);
    killed.extend(supervisor.end(|name| name.starts_with("agent"), all_until));
    killed.extend(supervisor.end(|name| name != RECORDER, all_until));
    // The recorder last, as it takes down what the others send until their end.
    killed.extend(supervisor.end(|_| true, all_until + RECORDER_SHARE));
    display.finish();
    // Events that came while the processes were ended, which nobody has read.
    while let Ok(event) = process_events.try_recv() {
        watch.note(&event);
    }
    // Messages of any process may have been lost in that time.
    if watch.had_outages() {
        offline.extend(everyone);
    }
    offline.extend(watch.crashed());
    offline.extend(killed.iter().cloned());
    // The router of the run ends next, after the scorer.
    watch.note(&ProcessEvent {
        name: ROUTER.to_owned(),
        what: ProcessEventKind::Done { data_lost: false },
    });
    watch.write_status(Phase::Over, &scorer.progress());
    Ok(Watched {
        ending,
        killed,
        offline,
        failures: watch.failures(),
        causes: watch.causes(),
    })
}

/// Deadlines of the steps of the end: of the replay, of the last results, of all others. After Ctrl-C everything has to
/// end within `stop_s`; a run that is over waits for its last results first.
fn deadlines(timeouts: &Timeouts, ending: &Ending) -> [Instant; 3] {
    let (drain_s, stop_s) = (timeouts.drain_s, timeouts.stop_s);
    let limits_s = match ending {
        // The replay has ended by itself.
        Ending::Over => [0.0, drain_s, drain_s + stop_s],
        Ending::Asked => [stop_s * REPLAY_SHARE, stop_s * DRAIN_SHARE, stop_s],
        // The run has failed, so no further results are waited for.
        Ending::Failed { .. } => [stop_s, 0.0, stop_s],
    };
    let now = Instant::now();
    limits_s.map(|after_s| now + Duration::from_secs_f64(after_s))
}

/// Waits until the ego has reported every tick, or the time is over.
fn drain(supervisor: &Supervisor, scorer: &ScorerNode, until: Instant, display: &mut Display) {
    while !supervisor.all_ended() && Instant::now() < until {
        let progress = scorer.progress();
        display.update(&progress);
        // The number of ticks is final only after the replay's last report.
        if progress.ended && progress.frames >= progress.ticks {
            return;
        }
        std::thread::sleep(BEAT.min(until.saturating_duration_since(Instant::now())));
    }
}

/// Syncs the files of lines: lines are appended without waiting for the disk, and only now have to be on it. Returns what
/// is incomplete, as text; `missing` is the number of lines of each file that found no room.
fn sync_lines(folder: &RunFolder, missing: [u64; 3]) -> Vec<String> {
    let mut incomplete = Vec::new();
    let files = LINES.map(|name| folder.file(name));
    for (file, lines) in files.iter().zip(missing).filter(|(_, lines)| *lines > 0) {
        incomplete.push(format!("{lines} lines are missing in {}", file.display()));
    }
    for file in &files {
        if let Err(error) = atomic_file::sync(file) {
            incomplete.push(format!("{}: {error}", file.display()));
        }
    }
    incomplete
}

/// Writes the run folder; files that cannot be written are listed in the result, which is not lost with them.
fn write(
    fleet: &Fleet,
    (run, folder): (&RunId, RunFolder),
    (scored, refused): (Scored, Vec<RefusalCount>),
    watched: &Watched,
    fingerprint: JoinHandle<Option<Provenance>>,
    capacity: Option<Capacity>,
) -> RunResult {
    let scores = &scored.scores;
    let mut unwritten = sync_lines(&folder, scored.unwritten);
    let mut sum = Ledger::default();
    let ledgers = scored.stats.iter().map(|process| &process.ledger);
    ledgers.for_each(|ledger| sum.merge(ledger));
    // Before the balance, which accounts of offline processes cannot meet.
    let exempted = sum.exempt(|account| offline_intervals::concerns(&watched.offline, account));
    let balance = sum.balance();
    let missed = missed(fleet, scores, &watched.ending);
    let provenance = fingerprint.join().ok().flatten();
    let mut metrics = metrics(fleet, scores, &scored.progress, &sum);
    metrics.left_out.merge(&fleet.left_out);
    metrics.ticks = metrics.answered + missed;
    metrics.provenance = provenance.clone().map(Provenance::with_command);
    let mut written = vec![folder.write_json(deploy::score::metrics::FILE, &metrics)];
    let remedies = remedies(fleet, capacity.as_ref());
    let mut run_report = RunReport::new(run, &metrics, scores.records(), &scored.stats, capacity);
    run_report.causes.clone_from(&watched.causes);
    written.push(folder.write_json(report::FILE, &run_report));
    let arrivals = sweep_arrivals(&folder.file(SWEEP_LOG));
    let frames = frames_csv(scores.records(), &arrivals, None);
    written.push(folder.write("frames.csv", &frames));
    let report = LedgerReport {
        balances: balance.is_exact(),
        balance: balance.clone(),
        offline: watched.offline.clone(),
        exempted,
        total: sum.delivered(),
        sum,
        refused,
        causes: watched.causes.clone(),
        processes: scored.stats,
    };
    written.push(folder.write_json("ledger.json", &report));
    let resolved = Scenario {
        run: Some(run.clone()),
        provenance,
        ..fleet.scenario.clone()
    };
    written.push(folder.write("scenario.yaml", &resolved.to_yaml()));
    let errors = written.into_iter().filter_map(|written| written.err());
    unwritten.extend(errors.map(|error| error.to_string()));
    let picture = crate::run::demo::draw(fleet, scores, &folder.file("frame.png"));
    let interrupted = matches!(watched.ending, Ending::Asked);
    RunResult {
        folder,
        metrics,
        balance,
        missed,
        interrupted,
        killed: watched.killed.clone(),
        unwritten,
        failures: watched.failures.clone(),
        remedies: Some(remedies),
        report: run_report,
        picture,
    }
}

/// Ticks without a result, of those that count. Those that no process reported, as the replay crashed with them in transit,
/// are known by their number only, once the scene is over.
fn missed(fleet: &Fleet, scores: &FrameScores, ending: &Ending) -> u64 {
    let reported = scores.ticks().0 + scores.unplaced().len() as u64;
    // After an early end it is unknown how many ticks were due.
    let played = fleet.ticks.filter(|_| matches!(ending, Ending::Over));
    scores.missed() + (played.unwrap_or(0) as u64).saturating_sub(reported)
}

fn metrics(fleet: &Fleet, scores: &FrameScores, progress: &Progress, sum: &Ledger) -> Metrics {
    let span = { progress.span }.map(|(first, last)| (last - first).as_secs_f64());
    let names = [fleet.scenario.method.name(), fleet.pose_source()];
    let mut metrics = Metrics {
        protocol: Some(fleet.applied_protocol()),
        ..Metrics::of(scores, "wall", names, span.unwrap_or(0.0), sum, None)
    };
    let variant = fleet.scenario.scene.variant.as_deref();
    for &tick in scores.unplaced() {
        let at = (tick as usize, &fleet.ego);
        add_unplaced_tick(&mut metrics.left_out, &fleet.recorded, at, variant);
    }
    metrics
}
