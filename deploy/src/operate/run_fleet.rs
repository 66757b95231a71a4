//! One run from beginning to end: plan, start, watch, end, score, write.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};
use std::sync::mpsc::channel;
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use bus::shutdown::Stop;
use bus::{BusError, Endpoint, Rejection};
use ego_fuser_offline::evaluation::EvaluateError;
use protocol::{Ledger, ProcessId, Reconciliation, RunId};

use crate::experiment::fingerprint::Provenance;
use crate::experiment::ledger_report::LedgerReport;
use crate::experiment::metrics::Metrics;
use crate::experiment::progress::Display;
use crate::experiment::score::{FrameScores, Progress, Scored, ScorerError, ScorerNode};
use crate::operate::fleet::{Fleet, FleetError, RECORDER, REPLAY, SessionContext};
use crate::operate::keys::KeyError;
use crate::operate::network::RouterEndpoint;
use crate::operate::offline_intervals;
use crate::operate::run_folder::{RunFolder, RunFolderError, SWEEP_LOG, name_of_now};
use crate::operate::security::RefusalWatch;
use crate::operate::status::Phase;
use crate::operate::status_reporter::{Ending, StatusReporter};
use crate::operate::supervise::{ProcessSpec, SuperviseError, Supervisor};
use crate::scenario::{Clock, Scenario};

/// How often the display is brought up to date.
const BEAT: Duration = Duration::from_millis(100);
/// Of the time for ending: until the replay must be gone.
const REPLAY_SHARE: f64 = 0.25;
/// Of the time for ending: until the last results must have come.
const DRAIN_SHARE: f64 = 0.5;

/// For writing the index of a recording, after all others have ended.
const RECORDER_SHARE: Duration = Duration::from_millis(800);

/// What a run needs beside its scenario.
#[derive(Debug, Clone)]
pub struct UpOptions {
    /// Folder of the run folders.
    pub runs: PathBuf,
    /// Folder of the programs `agent`, `ego-fuser` and `sim-replay`.
    pub programs: PathBuf,
    /// First part of the name of a run that has none.
    pub prefix: &'static str,
}

/// What a run has come to.
#[derive(Debug)]
pub struct RunResult {
    /// Where everything is.
    pub folder: RunFolder,
    /// The numbers.
    pub metrics: Metrics,
    /// Whether every message is accounted for.
    pub balance: Reconciliation,
    /// Ticks of which the ego never told anything.
    pub missed: u64,
    /// Someone ended it before it was over.
    pub interrupted: bool,
    /// Processes that did not end in time and were killed.
    pub killed: Vec<String>,
    /// What could not be written of the run, in words: the disk is full, perhaps.
    pub unwritten: Vec<String>,
    /// Processes that failed in what they were to do, in words.
    pub failures: Vec<String>,
    /// The picture of one fused frame, where there was one to draw.
    pub picture: Option<PathBuf>,
}

impl RunResult {
    /// Whether data were lost beyond what the link dropped.
    #[must_use]
    pub fn lost_data(&self) -> bool {
        let dropped = self.metrics.messages.dropped.iter().any(|(reason, count)| reason.is_loss() && *count > 0);
        dropped
            || self.missed > 0
            || !self.balance.is_exact()
            || !self.unwritten.is_empty()
            || !self.failures.is_empty()
            || !self.killed.is_empty()
            || self.metrics.messages.are_stuck()
    }
}

/// Why a run came to nothing.
#[derive(Debug, thiserror::Error)]
pub enum UpError {
    /// The scenario makes no fleet.
    #[error(transparent)]
    Fleet(#[from] FleetError),
    /// The run folder cannot be used.
    #[error(transparent)]
    Folder(#[from] RunFolderError),
    /// The processes cannot meet.
    #[error(transparent)]
    Network(#[from] BusError),
    /// Another fleet of that name is there; both would fall silent.
    #[error(
        "run {run} is already live on {router}: {}; choose another --name, or end it first",
        processes.iter().map(ToString::to_string).collect::<Vec<_>>().join(", ")
    )]
    Live {
        /// Its name.
        run: RunId,
        /// Where.
        router: String,
        /// Which of the processes that would be started are there.
        processes: Vec<ProcessId>,
    },
    /// There are no keys for the processes.
    #[error("security: {0}")]
    Keys(#[from] KeyError),
    /// The scorer cannot work.
    #[error("scorer: {0}")]
    Scorer(#[from] ScorerError),
    /// The processes cannot be started.
    #[error(transparent)]
    Supervise(#[from] SuperviseError),
    /// Signals cannot be caught.
    #[error("cannot catch Ctrl-C: {0}")]
    Signals(std::io::Error),
    /// A run in virtual time cannot be computed.
    #[error(transparent)]
    Evaluate(Box<EvaluateError>),
    /// A process stays down.
    #[error("{process} {how} (log: {})", log.display())]
    Process {
        /// Which.
        process: String,
        /// How it ended.
        how: String,
        /// Its log.
        log: PathBuf,
    },
}

impl UpError {
    /// Whether the input is at fault, and not the run.
    #[must_use]
    pub fn is_bad_input(&self) -> bool {
        match self {
            Self::Network(error) => error.is_bad_input(),
            Self::Fleet(_) | Self::Folder(RunFolderError::Pop(_)) | Self::Live { .. } => true,
            Self::Evaluate(error) => matches!(**error, EvaluateError::TooSlow { .. } | EvaluateError::Link(_)),
            _ => false,
        }
    }

    /// Whether the run was refused before anything of it began, so that nothing in its folder is of use.
    pub(crate) fn is_refusal(&self) -> bool {
        match self {
            Self::Process { .. } | Self::Folder(_) => false,
            Self::Evaluate(_) => self.is_bad_input(),
            _ => true,
        }
    }
}

/// RunScope a scenario to its end, or until Ctrl-C.
///
/// # Errors
/// [`UpError`] when the run cannot start, or a process stays down.
pub fn up(scenario: &Scenario, options: &UpOptions) -> Result<RunResult, UpError> {
    if scenario.clock == Clock::Stepped {
        return crate::experiment::stepped::up(scenario, options);
    }
    let fleet = Fleet::plan(scenario)?;
    let run = fleet.scenario.run.clone().unwrap_or_else(|| name_of_now(options.prefix));
    let folder = RunFolder::create(&options.runs, &run)?;
    let result = go(&fleet, options, &run, &folder);
    if result.as_ref().is_err_and(UpError::is_refusal) {
        folder.remove();
    }
    result
}

/// RunScope a fleet, as the run of that name in that folder.
fn go(fleet: &Fleet, options: &UpOptions, run: &RunId, folder: &RunFolder) -> Result<RunResult, UpError> {
    let stop = Stop::new();
    stop.on_signals().map_err(UpError::Signals)?;
    let fingerprint = fingerprint(fleet, &options.programs);

    let keys = fleet.keys(folder)?;
    let place = RouterEndpoint::open(&fleet.scenario.network, run, keys.as_ref())?;
    let (endpoint, programs) = (&place.endpoint, options.programs.as_path());
    let meeting = SessionContext { run, endpoint, keys: keys.as_ref(), programs, folder };
    let specs = fleet.processes(&meeting)?;
    place.check_free(&fleet.scenario.network, run, &specs)?;
    let refused = RefusalWatch::over(&place)?;
    let board = FrameScores::new(fleet.ego.clone(), fleet.ground_truth_rule(), fleet.map_values());
    let detections = folder.file("detections.jsonl");
    let mut scorer = ScorerNode::start(place.session.clone(), run, &fleet.agents, &fleet.ego, board, detections)?;
    if let Some(address) = fleet.scenario.network.metrics {
        scorer.serve_metrics(address)?;
    }
    let watched = watch(fleet, &meeting, specs, &place.endpoint, &scorer, &stop);
    // Before the scorer closes the session.
    let refused = refused.finish();
    let scored = scorer.finish();
    if let Err(overdue) = place.close() {
        tracing::warn!("{overdue}");
    }
    let watched = watched?;

    let result = write(fleet, run, folder.clone(), (scored, &refused), &watched, fingerprint);
    match watched.ending {
        Ending::Over | Ending::Asked => Ok(result),
        Ending::Failed { process, how } => {
            let log = result.folder.log_dir().join(format!("{process}.log"));
            Err(UpError::Process { process, how, log })
        }
    }
}

/// What a run was like for those who watched.
struct Watched {
    ending: Ending,
    /// Who had to be killed at the end.
    killed: Vec<String>,
    /// Who was away for a while.
    away: BTreeSet<String>,
    /// Who failed in what they were to do, in words.
    failures: Vec<String>,
}

/// When each sweep came to the ego's agent. One on another host notes nothing here.
fn swept(log: &Path) -> BTreeMap<u64, u64> {
    agent::sweep_log::read(log).unwrap_or_else(|error| {
        if error.kind() != std::io::ErrorKind::NotFound {
            tracing::warn!("{}: {error}; frames.csv does not say when sweeps came", log.display());
        }
        BTreeMap::new()
    })
}

/// Starts the processes, follows the run to its end, and ends the processes.
fn watch(
    fleet: &Fleet,
    meeting: &SessionContext<'_>,
    specs: Vec<ProcessSpec>,
    endpoint: &Endpoint,
    scorer: &ScorerNode,
    stop: &Stop,
) -> Result<Watched, UpError> {
    let SessionContext { run, folder, .. } = *meeting;
    let (events, happened) = channel();
    let mut display = Display::new(fleet.ticks);
    for ProcessSpec { name, metrics, .. } in &specs {
        if let Some(address) = metrics {
            display.say(&format!("metrics of {name} at http://{address}/metrics"));
        }
    }
    let restarts = fleet.scenario.timeouts.restarts;
    display.say(&format!("run {run} at {endpoint}: {} processes, logs in {}", specs.len(), folder.log_dir().display()));
    let mut supervisor = Supervisor::start(specs, &folder.log_dir(), restarts, &events)?;
    let mut watch = StatusReporter::new(fleet, run, endpoint, folder);
    let ending = watch.follow(&supervisor, &happened, scorer, stop, &mut display);
    let mut away = scorer.absent();
    away.extend(watch.fallen());
    watch.tell(Phase::Ending, &scorer.progress());
    let limits = Limits::of(fleet, &ending);
    let mut killed = supervisor.end(|name| name == REPLAY, limits.replay).killed;
    drain(&supervisor, scorer, limits.drain, &mut display);
    killed.extend(supervisor.end(|name| name.starts_with("agent"), limits.all).killed);
    // The recorder hears everyone's last words.
    killed.extend(supervisor.end(|name| name != RECORDER, limits.all).killed);
    killed.extend(supervisor.end(|_| true, limits.all + RECORDER_SHARE).killed);
    display.finish();
    while let Ok(event) = happened.try_recv() {
        watch.note(&event);
    }
    watch.tell(Phase::Over, &scorer.progress());
    away.extend(killed.iter().cloned());
    let failures = watch.failures();
    Ok(Watched { ending, killed, away, failures })
}

/// Moments until which each step of the end has time.
struct Limits {
    replay: Instant,
    drain: Instant,
    all: Instant,
}

impl Limits {
    /// After Ctrl-C everything has to end within `stop_s`; a run that is over waits for its last results first.
    fn of(fleet: &Fleet, ending: &Ending) -> Self {
        let timeouts = &fleet.scenario.timeouts;
        let now = Instant::now();
        let after = |seconds: f64| now + Duration::from_secs_f64(seconds);
        match ending {
            Ending::Over => {
                Self { replay: now, drain: after(timeouts.drain_s), all: after(timeouts.drain_s + timeouts.stop_s) }
            }
            Ending::Asked => Self {
                replay: after(timeouts.stop_s * REPLAY_SHARE),
                drain: after(timeouts.stop_s * DRAIN_SHARE),
                all: after(timeouts.stop_s),
            },
            Ending::Failed { .. } => Self { replay: after(timeouts.stop_s), drain: now, all: after(timeouts.stop_s) },
        }
    }
}

/// Waits until the ego has told of every tick there was, or the time is over.
fn drain(supervisor: &Supervisor, scorer: &ScorerNode, until: Instant, display: &mut Display) {
    while !supervisor.all_ended() && Instant::now() < until {
        let progress = scorer.progress();
        display.update(&progress);
        // The number of ticks is known for certain only after the replay's last word on them.
        if progress.ended && progress.frames >= progress.ticks {
            return;
        }
        std::thread::sleep(BEAT.min(until.saturating_duration_since(Instant::now())));
    }
}

/// Hashes what the run is made of while the run goes.
fn fingerprint(fleet: &Fleet, programs: &Path) -> JoinHandle<std::io::Result<Provenance>> {
    let (programs, weights) = (Fleet::programs(programs), fleet.scenario.models.weights.clone());
    let scene = fleet.scene_dir.clone();
    let poses = fleet.scenario.poses();
    std::thread::spawn(move || Provenance::collect(&programs, &weights, &poses, &scene))
}

/// Writes the run folder; what cannot be written is told with the result, which is not lost with it.
fn write(
    fleet: &Fleet,
    run: &RunId,
    folder: RunFolder,
    (scored, refused): (Scored, &BTreeMap<Rejection, u64>),
    watched: &Watched,
    fingerprint: JoinHandle<std::io::Result<Provenance>>,
) -> RunResult {
    let Scored { board, books, progress, unwritten: lines } = scored;
    let mut unwritten = Vec::new();
    if lines > 0 {
        unwritten.push(format!("{lines} results are missing in {}", folder.file("detections.jsonl").display()));
    }
    let mut note = |written: Result<(), RunFolderError>| {
        if let Err(error) = written {
            unwritten.push(error.to_string());
        }
    };
    let mut sum = Ledger::default();
    for process in &books {
        sum.merge(&process.ledger);
    }
    let exempted = sum.exempt(|account| offline_intervals::concerns(&watched.away, account));
    let balance = sum.balance();
    let metrics = metrics(fleet, &board, &progress, &sum);
    note(folder.write_json("metrics.json", &metrics));
    note(folder.write_frames(board.records(), &swept(&folder.file(SWEEP_LOG))));
    let report = LedgerReport::new(&books, &sum, &balance, (&watched.away, exempted)).with_refused(refused);
    note(folder.write_json("ledger.json", &report));
    let provenance = match fingerprint.join() {
        Ok(Ok(provenance)) => Some(provenance),
        Ok(Err(error)) => {
            tracing::warn!("no hashes in scenario.yaml: {error}");
            None
        }
        Err(_) => None,
    };
    let resolved = Scenario { run: Some(run.clone()), provenance, ..fleet.scenario.clone() };
    note(folder.write("scenario.yaml", &resolved.to_yaml()));
    let picture = crate::view::demo::draw(fleet, &board, &folder.file("frame.png"));
    let interrupted = matches!(watched.ending, Ending::Asked);
    let (killed, failures) = (watched.killed.clone(), watched.failures.clone());
    let missed = missed(fleet, &board, &watched.ending);
    RunResult { folder, metrics, balance, missed, interrupted, killed, unwritten, failures, picture }
}

/// Ticks without a result. Those that nobody told of at all, as the replay fell with them on its way, are known by their
/// number alone, once the scene is over.
fn missed(fleet: &Fleet, board: &FrameScores, ending: &Ending) -> u64 {
    let told = board.records().len() as u64 + board.missed();
    let played = fleet.ticks.filter(|_| matches!(ending, Ending::Over)).unwrap_or(0) as u64;
    board.missed() + played.saturating_sub(told)
}

fn metrics(fleet: &Fleet, board: &FrameScores, progress: &Progress, sum: &Ledger) -> Metrics {
    let seconds = progress.span.map_or(0.0, |(first, last)| last.duration_since(first).as_secs_f64());
    let names = [fleet.scenario.method.name(), fleet.pose_source()];
    Metrics::of(board, "wall", names, seconds, sum, None)
}
