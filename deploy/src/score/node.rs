//! Scorer process on the bus: receives truth, detections, tracks, poses and the ledgers of all processes, and keeps the scores.

use std::collections::{BTreeMap, BTreeSet, VecDeque};
use std::net::SocketAddr;
use std::path::PathBuf;
use std::sync::{Arc, Mutex};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use bus::bounded_queue::Pop;
use bus::{
    Arrival, Bus, BusError, Event, Identity, Inbox, LivelinessToken, MetricsPeer, Subscription,
    process_id, process_usage,
};
use protocol::{
    CavId, Detections, FrameReport, KeyExpr, Ledger, Limits, NeighbourState, PoseEstimate,
    ProcessId, ProcessUsage, Role, RunId, StageSummary, Stats, Stream, Topic, TopicTraffic, Tracks,
    Truth,
};
use serde::Serialize;
use support::sync::{lock, spawn};
use zenoh::Session;

use super::FrameScores;
use super::numbered_results::{RecentMessages, RecentTick, numbered};
use super::result_lines::ResultLines;
use super::stage_stamps::ms_between;
use crate::score::offline_intervals::OfflineIntervals;

/// Name of the scorer in keys, ledgers and routes.
pub(crate) const SCORER: &str = "scorer";
/// Largest number of waiting messages of one topic: seconds of a run.
const PLACES: usize = 256;
/// Longest time for closing the session.
const LEAVE_LIMIT: Duration = Duration::from_millis(500);

/// Progress of a run.
#[derive(Debug, Clone, Default)]
pub struct Progress {
    /// Number of ticks published by the replay.
    pub ticks: u64,
    /// Number of results of the ego.
    pub frames: u64,
    /// Arrival times of the first and the last result.
    pub span: Option<(Instant, Instant)>,
    /// From the publication of the tick to that of its result, milliseconds, of the last result.
    pub latency_ms: Option<f64>,
    /// Number of neighbours in the last result.
    pub fused: usize,
    /// Neighbours whose messages the ego received for the last result, and its judgement of each.
    pub neighbours: Vec<NeighbourState>,
    /// Bytes of all fused messages so far.
    pub wire_bytes: u64,
    /// Number of messages dropped so far, by all processes.
    pub dropped: u64,
    /// True once the replay has announced the end of the scene.
    pub ended: bool,
    /// Time of the last report of each process, by name.
    pub last_reports: BTreeMap<String, Instant>,
    /// Problems in the last report of each process, by name.
    pub problems: BTreeMap<String, Vec<String>>,
}

impl Progress {
    /// Results per second.
    pub fn rate_hz(&self) -> Option<f64> {
        let (first, last) = self.span?;
        let seconds = last.duration_since(first).as_secs_f64();
        (self.frames > 1 && seconds > 0.0).then(|| (self.frames - 1) as f64 / seconds)
    }
}

/// Ledger and resources of one process instance.
#[derive(Debug, Clone, Serialize)]
pub struct ProcessStats {
    /// Name of the process.
    pub process: ProcessId,
    /// Its message counters.
    pub ledger: Ledger,
    /// Its stages.
    pub stages: Vec<StageSummary>,
    /// Its CPU time and memory.
    #[serde(skip)]
    pub usage: ProcessUsage,
    /// CPU time and memory before the first tick: for loading models and for joining the run.
    #[serde(skip)]
    pub usage_before: ProcessUsage,
    /// Its published bytes, by topic.
    #[serde(skip)]
    pub traffic: Vec<TopicTraffic>,
}

/// Largest number of process instances whose ledgers are kept: a fleet of 65 vehicles that all crash a few times.
const MAX_INSTANCES: usize = 1024;

/// Last ledger of every process and epoch.
type ScoreStats = BTreeMap<(ProcessId, u64), ProcessStats>;

/// Results of the scorer at the end.
pub struct Scored {
    /// Detections against the truth.
    pub scores: FrameScores,
    /// Last report of every process instance.
    pub stats: Vec<ProcessStats>,
    /// Progress of the run.
    pub progress: Progress,
    /// Number of results, of ticks and of tracks of a frame that are not in their files, for lack of disk space.
    pub unwritten: [u64; 3],
}

/// Reason why the scorer cannot start.
#[derive(Debug, thiserror::Error)]
pub enum ScorerError {
    /// Error of the bus.
    #[error(transparent)]
    Bus(#[from] BusError),
    /// A file or thread cannot be created.
    #[error("{what}: {source}")]
    Io {
        /// File or thread.
        what: String,
        /// Error of the operating system.
        source: std::io::Error,
    },
}

/// A running scorer.
pub struct ScorerNode {
    inbox: Arc<Inbox>,
    progress: Arc<Mutex<Progress>>,
    thread: JoinHandle<(FrameScores, ScoreStats, [u64; 3])>,
    bus: Bus,
    offline: OfflineIntervals,
    subscriptions: Vec<Subscription>,
    presence: LivelinessToken,
}

impl ScorerNode {
    /// Subscribes to the run of `agents` on `session`; results and ground truth are appended to `files`, one JSON object
    /// a line, and so are the tracks if their file is named.
    ///
    /// # Errors
    /// [`ScorerError`] when the bus, the file or the system refuses.
    pub fn start(
        session: Session,
        run: &RunId,
        agents: &[CavId],
        ego: &CavId,
        scores: FrameScores,
        files: [PathBuf; 2],
        tracks: Option<PathBuf>,
    ) -> Result<Self, ScorerError> {
        let cav = scorer_cav();
        let process = process_id(Role::Scorer, &cav);
        let bus = Bus::over(session, Identity::new(run.clone(), process, cav))?;
        let inbox = bus.inbox(PLACES, 4 * agents.len() + 64);
        let detections = Topic::stream(ego, Stream::Detections);
        let mut subscriptions = vec![
            bus.subscribe(Topic::Truth, &inbox)?,
            bus.subscribe(detections, &inbox)?,
            bus.subscribe_all(&KeyExpr::stats(run), &inbox)?,
        ];
        if tracks.is_some() {
            subscriptions.push(bus.subscribe(Topic::stream(ego, Stream::Tracks), &inbox)?);
        }
        for cav in agents {
            subscriptions.push(bus.subscribe(Topic::stream(cav, Stream::Pose), &inbox)?);
        }
        let presence = bus.announce(Role::Scorer)?;
        let offline = OfflineIntervals::watch(&bus)?;
        let io = |what: String| move |source| ScorerError::Io { what, source };
        let lines =
            |file: &PathBuf| ResultLines::create(file).map_err(io(file.display().to_string()));
        let [detections, truth] = &files;
        let (detections, truth_lines) = (lines(detections)?, lines(truth)?);
        let tracks = tracks.as_ref().map(lines).transpose()?;
        let progress = Arc::<Mutex<Progress>>::default();
        let worker = ScorerWorker {
            inbox: Arc::clone(&inbox),
            bus_stats: bus.stats().clone(),
            scores,
            stats: BTreeMap::new(),
            reported_foreign: BTreeSet::new(),
            progress: Arc::clone(&progress),
            detections,
            truth_lines,
            tracks,
            waiting: VecDeque::new(),
            waiting_tracks: VecDeque::new(),
            recent: BTreeMap::new(),
            counted: RecentMessages::default(),
        };
        let thread = spawn(SCORER, move || worker.run());
        let thread = thread.map_err(io("the scorer's thread".into()))?;
        Ok(Self {
            inbox,
            progress,
            thread,
            bus,
            offline,
            subscriptions,
            presence,
        })
    }

    /// Serves the counters of the scorer and of the others to Prometheus.
    ///
    /// # Errors
    /// [`ScorerError::Bus`] when the address cannot be listened at.
    pub fn serve_metrics(
        &mut self,
        address: SocketAddr,
        others: Vec<MetricsPeer>,
    ) -> Result<(), ScorerError> {
        self.bus.serve_metrics(address, others)?;
        Ok(())
    }

    /// Progress so far.
    pub fn progress(&self) -> Progress {
        lock(&self.progress).clone()
    }

    /// Time since which the scorer has had no connection to the router.
    pub fn router_lost_since(&self) -> Option<Instant> {
        self.bus.router_lost_since()
    }

    /// Processes that were offline so far.
    pub fn absent(&self) -> BTreeSet<String> {
        self.offline.so_far()
    }

    /// Ends the scorer after every received message has been scored.
    ///
    /// # Panics
    /// When the scorer's own thread has panicked.
    pub fn finish(self) -> Scored {
        // A closed queue is still read to its end.
        self.inbox.close();
        let joined = self.thread.join();
        let (scores, stats, unwritten) =
            joined.expect("the scorer's thread has no reason to panic");
        let own_stats = self.bus.stats();
        let process = &self.bus.identity().process;
        let (own, others): (Vec<_>, Vec<_>) = stats
            .into_values()
            .partition(|stats| stats.process == *process);
        // The scorer receives its own reports like those of others; its current counters are newer.
        let own = ProcessStats {
            process: process.clone(),
            ledger: own_stats.ledger(),
            stages: own_stats.stages(),
            usage: process_usage(),
            usage_before: { own.into_iter().next() }
                .map(|own| own.usage_before)
                .unwrap_or_default(),
            traffic: own_stats.traffic(),
        };
        let scored = Scored {
            scores,
            stats: others.into_iter().chain([own]).collect(),
            progress: lock(&self.progress).clone(),
            unwritten,
        };
        // The bus demands that all subscriptions are ended before it leaves.
        drop((self.subscriptions, self.presence, self.offline));
        if let Err(overdue) = self.bus.leave(LEAVE_LIMIT) {
            tracing::warn!("{overdue}");
        }
        scored
    }
}

/// Id of the scorer in place of a vehicle's.
///
/// # Panics
/// Never: the name is an identifier.
pub fn scorer_cav() -> CavId {
    CavId::new(SCORER).expect("six lower-case letters")
}

/// Thread of the scorer.
struct ScorerWorker {
    inbox: Arc<Inbox>,
    bus_stats: bus::MessageStats,
    scores: FrameScores,
    stats: ScoreStats,
    /// Processes whose reports on messages of others are named already.
    reported_foreign: BTreeSet<ProcessId>,
    progress: Arc<Mutex<Progress>>,
    detections: ResultLines,
    truth_lines: ResultLines,
    tracks: Option<ResultLines>,
    /// Results that wait for their ticks, and tracks.
    waiting: VecDeque<FrameReport<Detections>>,
    waiting_tracks: VecDeque<FrameReport<Tracks>>,
    /// Recent ticks, by capture time: for results, and for the latency that is displayed during the run.
    recent: BTreeMap<u64, RecentTick>,
    /// Truth, results and tracks that count.
    counted: RecentMessages,
}

impl ScorerWorker {
    fn run(mut self) -> (FrameScores, ScoreStats, [u64; 3]) {
        loop {
            match self.inbox.take(None) {
                Pop::Item(topic, Event::Message(arrival)) => self.take(&topic, &arrival),
                Pop::Item(Topic::Truth, Event::End { .. }) => {
                    self.note(|progress| progress.ended = true)
                }
                Pop::Item(_, Event::End { .. }) | Pop::TimedOut => {}
                Pop::Closed => break,
            }
        }
        self.write_results(true);
        self.scores.close();
        let unwritten = [
            self.detections.finish(),
            self.truth_lines.finish(),
            self.tracks.map_or(0, ResultLines::finish),
        ];
        (self.scores, self.stats, unwritten)
    }

    fn take(&mut self, topic: &Topic, arrival: &Arrival) {
        let capture_nanos = arrival.header.stamp.capture_nanos;
        let used = match topic {
            Topic::Stats(sender) => return self.stats(sender, arrival),
            Topic::Stream { stream, .. } if *stream == Stream::Pose => self.pose(arrival),
            // The tick of a replay that was restarted counts once.
            _ if !self.counted.is_first(topic, capture_nanos) => Some(()),
            Topic::Truth => self.truth(arrival),
            Topic::Stream { stream, .. } => match stream {
                Stream::Detections => self.result(arrival),
                Stream::Tracks => self.tracks(arrival),
                _ => None,
            },
            _ => None,
        };
        // An invalid message is counted where it is decoded.
        if used.is_some() {
            self.bus_stats.received(topic);
        }
    }

    fn truth(&mut self, arrival: &Arrival) -> Option<()> {
        let truth: Truth = self.inbox.decode(arrival, &Limits::DEFAULT)?;
        let stamp = &arrival.header.stamp;
        let tick = RecentTick {
            tick: truth.tick,
            publish_nanos: stamp.publish_nanos,
        };
        self.recent.insert(stamp.capture_nanos, tick);
        while self.recent.len() > PLACES {
            self.recent.pop_first();
        }
        if let Some(line) = self.scores.truth_line(stamp, &truth) {
            self.truth_lines.add(&line);
        }
        self.scores.truth(stamp, truth);
        self.write_results(false);
        self.bus_stats.tick();
        self.note(|progress| progress.ticks += 1);
        Some(())
    }

    fn result(&mut self, arrival: &Arrival) -> Option<()> {
        let result: Detections = self.inbox.decode(arrival, &Limits::DEFAULT)?;
        let stamp = &arrival.header.stamp;
        let report = FrameReport::new(stamp, None, result.clone());
        self.waiting.push_back(report);
        self.write_results(false);
        let tick = self.recent.get(&stamp.capture_nanos);
        let latency_ms = tick.map(|tick| ms_between(tick.publish_nanos, stamp.publish_nanos));
        let neighbours = result.neighbours.clone();
        let fused = result.fused.len();
        let wire_bytes = result.fused.iter().map(|neighbour| neighbour.wire_bytes);
        let bytes: u64 = wire_bytes.sum();
        // The stamps may be of two clocks, but a duration cannot be negative.
        let latency = latency_ms.map(|ms| Duration::from_secs_f64(ms.max(0.0) / 1e3));
        self.bus_stats.answered(latency, fused);
        let at = arrival.at;
        self.note(|progress| {
            progress.frames += 1;
            progress.span = Some((progress.span.map_or(at, |(first, _)| first), at));
            progress.latency_ms = latency_ms;
            progress.fused = fused;
            progress.neighbours = neighbours;
            progress.wire_bytes += bytes;
        });
        self.scores.result(stamp, result);
        Some(())
    }

    fn tracks(&mut self, arrival: &Arrival) -> Option<()> {
        let tracks: Tracks = self.inbox.decode(arrival, &Limits::DEFAULT)?;
        let report = FrameReport::new(&arrival.header.stamp, None, tracks);
        self.waiting_tracks.push_back(report);
        self.write_results(false);
        Some(())
    }

    /// Writes the results whose tick is known, or will not be.
    fn write_results(&mut self, is_over: bool) {
        while let Some(report) = numbered(&mut self.waiting, &self.recent, is_over) {
            self.detections.add(&report);
        }
        if let Some(lines) = &mut self.tracks {
            while let Some(report) = numbered(&mut self.waiting_tracks, &self.recent, is_over) {
                lines.add(&report);
            }
        }
    }

    fn pose(&mut self, arrival: &Arrival) -> Option<()> {
        let estimate: PoseEstimate = self.inbox.decode(arrival, &Limits::DEFAULT)?;
        self.scores.pose(&arrival.header.stamp, estimate);
        Some(())
    }

    fn stats(&mut self, sender: &ProcessId, arrival: &Arrival) {
        let Some(mut report): Option<Stats> = self.inbox.decode(arrival, &Limits::DEFAULT) else {
            return;
        };
        let process = report.process;
        // A restarted process has another epoch: both instances count.
        let instance = (process.clone(), arrival.header.stamp.epoch);
        let has_room = self.stats.len() < MAX_INSTANCES || self.stats.contains_key(&instance);
        if process != *sender || !has_room {
            return tracing::warn!(%sender, %process, "report with another process's name, or of too many processes: ignored");
        }
        let foreign = report.ledger.remove_foreign(&process);
        if let Some(first) = foreign.first()
            && self.reported_foreign.insert(process.clone())
        {
            let others = foreign.len() - 1;
            tracing::warn!(%process, "report on messages of other processes, {first} and {others} more: ignored");
        }
        let (name, at) = (process.to_string(), arrival.at);
        // Until the first tick: the loading of models belongs to no frame.
        let usage_before = match self.stats.get(&instance) {
            _ if self.recent.is_empty() => report.usage.clone(),
            Some(known) => known.usage_before.clone(),
            None => ProcessUsage::default(),
        };
        let stats = ProcessStats {
            process,
            ledger: report.ledger,
            stages: report.stages,
            usage: report.usage,
            usage_before,
            traffic: report.traffic,
        };
        self.stats.insert(instance, stats);
        let ledgers = self.stats.values().map(|stats| &stats.ledger);
        let dropped = ledgers.map(|ledger| ledger.total().dropped_total()).sum();
        self.note(|progress| {
            progress.dropped = dropped;
            progress.problems.insert(name.clone(), report.problems);
            progress.last_reports.insert(name, at);
        });
    }

    fn note(&self, change: impl FnOnce(&mut Progress)) {
        change(&mut lock(&self.progress));
    }
}
