//! The scorer's place on the bus: takes truth, detections, poses and everyone's books, and keeps the board.

use std::collections::{BTreeMap, BTreeSet};
use std::path::PathBuf;
use std::sync::{Arc, Mutex, PoisonError};
use std::thread::{self, JoinHandle};
use std::time::{Duration, Instant};

use bus::bounded_queue::Pop;
use bus::{Arrival, Bus, BusError, Event, Identity, Inbox, LivelinessToken, Subscription, process_id};
use protocol::{
    CavId, Detections, DetectionsReport, HeardNeighbour, KeyExpr, Ledger, Limits, PoseEstimate, ProcessId, Role, RunId,
    StageSummary, Stats, Stream, Topic, Truth,
};
use zenoh::Session;

use super::FrameScores;
use super::numbered_results::NumberedResults;
use super::result_lines::ResultLines;
use crate::operate::offline_intervals::OfflineIntervals;

/// Name of the scorer in keys, ledgers and routes.
const SCORER: &str = "scorer";
/// Messages of one topic that may wait: seconds of a run.
const PLACES: usize = 256;
/// How long the end of the session may take.
const LEAVE_LIMIT: Duration = Duration::from_millis(500);

/// How a run goes, for those who watch.
#[derive(Debug, Clone, Default)]
pub struct Progress {
    /// Ticks published by the replay.
    pub ticks: u64,
    /// Results of the ego.
    pub frames: u64,
    /// When the first and the last result came.
    pub span: Option<(Instant, Instant)>,
    /// From the publication of the tick to that of its result, milliseconds, of the last result.
    pub latency_ms: Option<f64>,
    /// Neighbours in the last result.
    pub fused: usize,
    /// What the ego makes of those it heard for it.
    pub heard: Vec<HeardNeighbour>,
    /// Bytes of everything that was fused so far.
    pub wire_bytes: u64,
    /// Messages dropped so far, by all processes.
    pub dropped: u64,
    /// The replay has said that nothing more will come.
    pub ended: bool,
    /// When each process last told about itself, by name.
    pub told: BTreeMap<String, Instant>,
}

impl Progress {
    /// Results per second.
    #[must_use]
    pub fn rate_hz(&self) -> Option<f64> {
        let (first, last) = self.span?;
        let seconds = last.duration_since(first).as_secs_f64();
        (self.frames > 1 && seconds > 0.0).then(|| (self.frames - 1) as f64 / seconds)
    }
}

/// The books of one life of a process.
#[derive(Debug, Clone)]
pub struct ProcessBooks {
    /// Which process.
    pub process: ProcessId,
    /// Its messages.
    pub ledger: Ledger,
    /// Its stages.
    pub stages: Vec<StageSummary>,
}

/// Lives of processes whose books are kept: a fleet of 65 vehicles that all fall a few times.
const MAX_LIVES: usize = 1024;

/// The last books of every process and epoch.
type ScoreStats = BTreeMap<(ProcessId, u64), ProcessBooks>;

/// Everything the scorer has at the end.
pub struct Scored {
    /// Detections against the truth.
    pub board: FrameScores,
    /// The last word of every process, by process and life.
    pub books: Vec<ProcessBooks>,
    /// How it went.
    pub progress: Progress,
    /// Results that are not in the file, as there was no room for them.
    pub unwritten: u64,
}

/// Why the scorer cannot work.
#[derive(Debug, thiserror::Error)]
pub enum ScorerError {
    /// The bus refuses.
    #[error(transparent)]
    Bus(#[from] BusError),
    /// A file or thread cannot be had.
    #[error("{what}: {source}")]
    Io {
        /// What.
        what: String,
        /// Why.
        source: std::io::Error,
    },
}

/// A scorer at work.
pub struct ScorerNode {
    bus: Bus,
    inbox: Arc<Inbox>,
    progress: Arc<Mutex<Progress>>,
    thread: JoinHandle<(FrameScores, ScoreStats, u64)>,
    absences: OfflineIntervals,
    _subscriptions: Vec<Subscription>,
    _presence: LivelinessToken,
}

impl ScorerNode {
    /// Listens to the run of `agents` on `session`; results go to `detections_file` as they come, one JSON object a
    /// line.
    ///
    /// # Errors
    /// [`ScorerError`] when the bus, the file or the system refuses.
    pub fn start(
        session: Session,
        run: &RunId,
        agents: &[CavId],
        ego: &CavId,
        board: FrameScores,
        detections_file: PathBuf,
    ) -> Result<Self, ScorerError> {
        let cav = scorer_cav();
        let process = process_id(Role::Scorer, &cav);
        let bus = Bus::over(session, Identity { run: run.clone(), process, cav })?;
        let inbox = bus.inbox(PLACES, 4 * agents.len() + 64);
        let detections = Topic::Stream { cav: ego.clone(), stream: Stream::Detections };
        let mut subscriptions = vec![
            bus.subscribe(Topic::Truth, &inbox)?,
            bus.subscribe(detections, &inbox)?,
            bus.subscribe_all(&KeyExpr::stats(run), &inbox)?,
        ];
        for cav in agents {
            subscriptions.push(bus.subscribe(Topic::Stream { cav: cav.clone(), stream: Stream::Pose }, &inbox)?);
        }
        let presence = bus.announce(Role::Scorer)?;
        let absences = OfflineIntervals::watch(&bus)?;
        let io = |what: String| move |source| ScorerError::Io { what, source };
        let detections = ResultLines::create(&detections_file).map_err(io(detections_file.display().to_string()))?;
        let progress = Arc::<Mutex<Progress>>::default();
        let worker = Worker {
            inbox: Arc::clone(&inbox),
            bus_books: bus.books().clone(),
            board,
            books: BTreeMap::new(),
            progress: Arc::clone(&progress),
            detections,
            numbered: NumberedResults::default(),
            published: BTreeMap::new(),
        };
        let thread = thread::Builder::new().name(SCORER.into()).spawn(move || worker.run());
        let thread = thread.map_err(io("the scorer's thread".into()))?;
        Ok(Self { bus, inbox, progress, thread, absences, _subscriptions: subscriptions, _presence: presence })
    }

    /// Serves the scorer's own counters to Prometheus.
    ///
    /// # Errors
    /// [`ScorerError::Bus`] when the address cannot be listened at.
    pub fn serve_metrics(&mut self, address: std::net::SocketAddr) -> Result<(), ScorerError> {
        self.bus.serve_metrics(address)?;
        Ok(())
    }

    /// How it goes.
    #[must_use]
    pub fn progress(&self) -> Progress {
        self.progress.lock().unwrap_or_else(PoisonError::into_inner).clone()
    }

    /// Who was away so far, by process.
    #[must_use]
    pub fn absent(&self) -> BTreeSet<String> {
        self.absences.so_far()
    }

    /// Ends the scorer after everything that has come in is judged.
    ///
    /// # Panics
    /// When the scorer's own thread has panicked.
    #[must_use]
    pub fn finish(self) -> Scored {
        self.inbox.close();
        let (board, books, unwritten) = self.thread.join().expect("the scorer's thread has no reason to panic");
        let own = ProcessBooks {
            process: self.bus.identity().process.clone(),
            ledger: self.bus.books().ledger(),
            stages: self.bus.books().stages(),
        };
        let progress = self.progress.lock().unwrap_or_else(PoisonError::into_inner).clone();
        drop((self._subscriptions, self._presence, self.absences));
        if let Err(overdue) = self.bus.leave(LEAVE_LIMIT) {
            tracing::warn!("{overdue}");
        }
        // Its own books went out like everyone's and came back; those in hand are newer.
        let others = books.into_values().filter(|books| books.process != own.process);
        Scored { board, books: others.chain([own.clone()]).collect(), progress, unwritten }
    }
}

/// The scorer's name in place of a vehicle's.
///
/// # Panics
/// Never: the name is an identifier.
#[must_use]
pub fn scorer_cav() -> CavId {
    CavId::new(SCORER).expect("six lower-case letters")
}

/// The scorer's thread.
struct Worker {
    inbox: Arc<Inbox>,
    bus_books: bus::MessageStats,
    board: FrameScores,
    books: ScoreStats,
    progress: Arc<Mutex<Progress>>,
    detections: ResultLines,
    numbered: NumberedResults,
    // When each recent tick was published, by capture time: for the latency that is shown while the run goes.
    published: BTreeMap<u64, u64>,
}

impl Worker {
    fn run(mut self) -> (FrameScores, ScoreStats, u64) {
        loop {
            match self.inbox.take(None) {
                Pop::Item(topic, Event::Message(arrival)) => self.take(&topic, &arrival),
                Pop::Item(Topic::Truth, Event::End { .. }) => self.note(|progress| progress.ended = true),
                Pop::Item(_, Event::End { .. }) | Pop::TimedOut => {}
                Pop::Closed => break,
            }
        }
        self.write_results(true);
        self.board.close();
        (self.board, self.books, self.detections.finish())
    }

    fn take(&mut self, topic: &Topic, arrival: &Arrival) {
        let used = match topic {
            Topic::Truth => self.truth(arrival),
            Topic::Stream { stream: Stream::Detections, .. } => self.result(arrival),
            Topic::Stream { stream: Stream::Pose, .. } => self.pose(arrival),
            Topic::Stats(sender) => return self.stats(sender, arrival),
            _ => None,
        };
        // An unsound message is counted where it is decoded.
        if used.is_some() {
            self.bus_books.received(topic);
        }
    }

    fn truth(&mut self, arrival: &Arrival) -> Option<()> {
        let truth: Truth = self.inbox.decode(arrival, &Limits::DEFAULT)?;
        let stamp = &arrival.header.stamp;
        self.published.insert(stamp.capture_nanos, stamp.publish_nanos);
        while self.published.len() > PLACES {
            self.published.pop_first();
        }
        self.numbered.tick(stamp.capture_nanos, truth.tick);
        self.board.truth(stamp, truth);
        self.write_results(false);
        self.note(|progress| progress.ticks += 1);
        Some(())
    }

    fn result(&mut self, arrival: &Arrival) -> Option<()> {
        let result: Detections = self.inbox.decode(arrival, &Limits::DEFAULT)?;
        let stamp = &arrival.header.stamp;
        self.numbered.result(DetectionsReport::new(stamp, None, result.clone()));
        self.write_results(false);
        let began = self.published.get(&stamp.capture_nanos);
        let latency_ms = began.map(|began| (stamp.publish_nanos as f64 - *began as f64) / 1e6);
        let heard = result.heard.clone();
        let (fused, bytes) =
            (result.fused.len(), result.fused.iter().map(|neighbour| neighbour.wire_bytes).sum::<u64>());
        let at = arrival.at;
        self.note(|progress| {
            progress.frames += 1;
            progress.span = Some((progress.span.map_or(at, |(first, _)| first), at));
            progress.latency_ms = latency_ms;
            progress.fused = fused;
            progress.heard = heard;
            progress.wire_bytes += bytes;
        });
        self.board.result(stamp, result);
        Some(())
    }

    /// Writes the results whose tick is known, or will not be.
    fn write_results(&mut self, is_over: bool) {
        while let Some(report) = self.numbered.next(is_over) {
            self.detections.add(&report);
        }
    }

    fn pose(&mut self, arrival: &Arrival) -> Option<()> {
        let estimate: PoseEstimate = self.inbox.decode(arrival, &Limits::DEFAULT)?;
        self.board.pose(&arrival.header.stamp, estimate);
        Some(())
    }

    fn stats(&mut self, sender: &ProcessId, arrival: &Arrival) {
        let Some(Stats { process, ledger, stages }) = self.inbox.decode(arrival, &Limits::DEFAULT) else { return };
        // A process that was started again has another epoch: both lives count.
        let life = (process.clone(), arrival.header.stamp.epoch);
        let has_room = self.books.len() < MAX_LIVES || self.books.contains_key(&life);
        if process != *sender || !has_room {
            return tracing::warn!(%sender, %process, "books of another process, or of too many: not taken");
        }
        let (name, at) = (process.to_string(), arrival.at);
        self.books.insert(life, ProcessBooks { process, ledger, stages });
        let dropped = self.books.values().map(|books| books.ledger.total().dropped_total()).sum();
        self.note(|progress| {
            progress.dropped = dropped;
            progress.told.insert(name, at);
        });
    }

    fn note(&self, change: impl FnOnce(&mut Progress)) {
        change(&mut self.progress.lock().unwrap_or_else(PoisonError::into_inner));
    }
}
