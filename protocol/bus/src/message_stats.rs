//! Message counters and stage durations of one process, shared by its threads.

use std::collections::{BTreeMap, BTreeSet, VecDeque};
use std::fmt;
use std::sync::{Arc, Mutex, MutexGuard};
use std::time::{Duration, Instant};

use protocol::text::{MAX_MESSAGE_BYTES, printable};
use protocol::{
    Account, CavId, DropReason, Ledger, Limits, ProcessId, RateReason, StageSummary, Topic,
    TopicTraffic, WireError,
};

use support::statistics::{quantile, sorted};
use support::sync::lock;

use super::Arrival;
use super::clock_offset::{ClockOffset, is_same_clock};
use super::frame_stats::FrameStats;

/// Maximum number of accounts of one process, equal to the limit of the ledger's receivers.
const MAX_ACCOUNTS: usize = Limits::DEFAULT.max_entries;
/// Maximum number of vehicles whose clock offset and trust are kept.
const MAX_PEERS: usize = 128;
/// Maximum number of problems at a time.
const MAX_PROBLEMS: usize = 16;
/// Timings kept per stage: at 10 Hz the last three minutes.
const KEPT_TIMINGS: usize = 2048;

/// Message counters of one process. Clones share them. Topics outside the accounting ([`Topic::is_counted`]) are not
/// counted.
#[derive(Debug, Clone)]
pub struct MessageStats {
    process: ProcessId,
    state: Arc<Mutex<CounterState>>,
}

/// Way of a large message of a process that has a pool of shared memory.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, strum::IntoStaticStr)]
#[strum(serialize_all = "snake_case")]
pub enum SharedMemoryUse {
    /// It was in shared memory.
    Carried,
    /// It took the socket: the pool had no room.
    PoolFull,
    /// It took the socket: the router is not attached to shared memory.
    RouterNotAttached,
}

#[derive(Debug, Default)]
struct CounterState {
    ledger: Ledger,
    // Messages of an account that have passed this process's queue: out of a sender's queue onto the network, or from
    // the network into a receiver's. The difference to the messages counted is in flight.
    passed: BTreeMap<Account, u64>,
    // Malformed messages, of any kind of topic.
    rejections: BTreeMap<Topic, u64>,
    stages: BTreeMap<String, Timings>,
    // Published messages and their bytes.
    traffic: BTreeMap<Topic, (u64, u64)>,
    frames: FrameStats,
    peers: BTreeMap<CavId, Peer>,
    shared: BTreeMap<SharedMemoryUse, u64>,
    problems: BTreeMap<String, Vec<(String, Instant)>>,
    // Problems that were logged.
    logged: BTreeSet<String>,
    is_full: bool,
}

/// State of a vehicle at this process.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Peer {
    pub(super) clock: Option<ClockOffset>,
    /// Trust score, 0..1; only with misbehaviour detection.
    pub(super) trust: Option<f64>,
}

/// Upper bounds of the histogram's buckets, seconds.
const BUCKETS_S: [f64; 14] = [
    0.0001, 0.00025, 0.0005, 0.001, 0.0025, 0.005, 0.01, 0.025, 0.05, 0.1, 0.25, 0.5, 1.0, 2.5,
];

/// Histogram of a stage over all its frames: its name, the number of frames, the sum of the durations in seconds, and of
/// every bucket the upper bound in seconds and the number of frames; the last is unbounded ([`f64::MAX`]).
pub(crate) type StageHistogram = (String, u64, f64, Vec<(f64, u64)>);

/// Durations of a stage, over all frames so far.
#[derive(Debug, Default)]
struct Timings {
    count: u64,
    sum: Duration,
    buckets: [u64; BUCKETS_S.len() + 1],
    max: Duration,
    last: VecDeque<Duration>,
}

impl MessageStats {
    /// Counters of `process`, all zero.
    pub fn new(process: ProcessId) -> Self {
        let state = Arc::default();
        Self { process, state }
    }

    /// Process of these counters.
    pub fn process(&self) -> &ProcessId {
        &self.process
    }

    /// Counts one more message submitted on `topic`.
    pub fn submitted(&self, topic: &Topic) {
        self.note_published(topic, |state, own| state.ledger.sent(&own));
    }

    /// Counts a submitted message as taken by the network.
    pub fn delivered(&self, topic: &Topic) {
        self.note_published(topic, |state, own| state.pass(own, 1));
    }

    /// Counts a submitted message as suppressed.
    pub fn suppressed(&self, topic: &Topic, reason: DropReason) {
        self.note_published(topic, |state, own| state.ledger.dropped(&own, reason));
    }

    /// Counts a submitted feature map as written to keep within a limit.
    pub fn adapted(&self, topic: &Topic, reason: RateReason) {
        self.note_published(topic, |state, own| state.ledger.adapted(&own, reason));
    }

    /// Opens the account of a subscription to `topic`.
    pub fn subscribed(&self, topic: &Topic) {
        self.note(topic, |state| state.ledger.open(&self.here(topic)));
    }

    /// Counts a message as delivered by the network, valid or not.
    pub fn arrived(&self, topic: &Topic) {
        self.note(topic, |state| state.pass(self.here(topic), 1));
    }

    /// Counts an arrived message as used.
    pub fn received(&self, topic: &Topic) {
        self.note(topic, |state| state.ledger.received(&self.here(topic)));
    }

    /// Counts an arrived message as not used.
    pub fn dropped(&self, topic: &Topic, reason: DropReason) {
        self.note(topic, |state| {
            state.ledger.dropped(&self.here(topic), reason)
        });
    }

    /// Counts messages that the router has taken and not handed on to this process.
    pub(super) fn undelivered(&self, topic: &Topic, messages: u32) {
        let (here, messages) = (self.here(topic), u64::from(messages));
        let why = DropReason::Undelivered;
        self.note(topic, |state| {
            state.ledger.dropped_many(&here, why, messages);
            // Passed as well: else the drops would hide as many messages that are still in flight.
            state.pass(here, messages);
        });
    }

    /// Counts a large message of a process with a pool of shared memory; the first on the socket is logged.
    pub(super) fn shared(&self, way: SharedMemoryUse) {
        let is_first = {
            let mut state = self.lock();
            let count = state.shared.entry(way).or_default();
            *count += 1;
            *count == 1
        };
        if is_first && way != SharedMemoryUse::Carried {
            tracing::warn!(
                reason = <&str>::from(way),
                "a large message takes the socket instead of shared memory"
            );
        }
    }

    /// Large messages of a process with a pool of shared memory, by their way.
    pub fn shared_memory(&self) -> BTreeMap<SharedMemoryUse, u64> {
        self.lock().shared.clone()
    }

    /// Counts an arrived message as malformed; logged ever more rarely, as a hostile peer must not fill the log.
    pub fn rejected(&self, topic: &Topic, error: &WireError) {
        self.reject(topic, error.drop_reason(), error);
    }

    /// Counts an arrived message as not used; logged like a malformed one.
    pub(super) fn reject(&self, topic: &Topic, reason: DropReason, why: impl fmt::Display) {
        self.dropped(topic, reason);
        self.warn_rejected(topic, reason, why);
    }

    /// Logs a message that is not used, as [`Self::rejected`].
    pub(super) fn warn_rejected(&self, topic: &Topic, reason: DropReason, why: impl fmt::Display) {
        let times = {
            let mut state = self.lock();
            let has_room =
                state.rejections.len() < MAX_ACCOUNTS || state.rejections.contains_key(topic);
            // Topics beyond the limit share one counter, that of the truth.
            let counted = if has_room { topic } else { &Topic::Truth };
            let times = state.rejections.entry(counted.clone()).or_default();
            *times += 1;
            *times
        };
        if times.is_power_of_two() {
            tracing::warn!(%topic, %reason, times, "message rejected: {why}");
        }
    }

    /// Updates the clock offset of `cav` from a message. Logged when it gets large, and when it is small again.
    pub(super) fn observe_clock(
        &self,
        cav: &CavId,
        sent_nanos: u64,
        arrived_nanos: u64,
        at: Instant,
    ) {
        let change = self.lock().peer(cav).and_then(|peer| {
            let clock = peer.clock.get_or_insert_with(|| ClockOffset::new(at));
            Some((clock.note(sent_nanos, arrived_nanos, at)?, clock.seconds()))
        });
        match change {
            Some((true, offset_s)) => {
                tracing::warn!(%cav, offset_s, "clock offset of the vehicle is large")
            }
            Some((false, offset_s)) => {
                tracing::info!(%cav, offset_s, "clock offset of the vehicle is small again")
            }
            None => {}
        }
    }

    /// Sets the trust score of a vehicle, 0..1.
    pub fn trusted(&self, cav: &CavId, trust: f64) {
        if let Some(peer) = self.lock().peer(cav) {
            peer.trust = Some(trust);
        }
    }

    /// System clock of a vehicle minus ours, seconds, minus the shortest transit time; `None`: no message of it.
    pub fn measured_clock_offset_s(&self, cav: &CavId) -> Option<f64> {
        let state = self.lock();
        Some(state.peers.get(cav)?.clock.as_ref()?.seconds())
    }

    /// System clock of a vehicle minus ours, seconds; 0 if they count as one clock. A transit time of up to
    /// `longest_transit_s` looks like a clock that is behind.
    pub fn system_clock_offset_s(&self, cav: &CavId, longest_transit_s: f64) -> f64 {
        let offset_s = self.measured_clock_offset_s(cav).unwrap_or(0.0);
        let is_same = is_same_clock(offset_s, longest_transit_s);
        if is_same { 0.0 } else { offset_s }
    }

    /// Time from the publication of a message to its arrival; `None` if its sender has another clock.
    pub fn transport(&self, arrival: &Arrival, longest_transit_s: f64) -> Option<Duration> {
        let offset_s = self.system_clock_offset_s(&arrival.header.stamp.cav, longest_transit_s);
        (offset_s == 0.0).then(|| arrival.transport())
    }

    /// State of the vehicles that have sent messages.
    pub(super) fn peers(&self) -> BTreeMap<CavId, Peer> {
        self.lock().peers.clone()
    }

    /// Sets the problems of a kind, in place of those before: text, and time of the beginning. Each
    /// is logged once.
    pub fn set_problems(&self, kind: &str, problems: impl IntoIterator<Item = (String, Instant)>) {
        let problems: Vec<_> = problems.into_iter().take(MAX_PROBLEMS).collect();
        let mut state = self.lock();
        for (problem, _) in &problems {
            if state.logged.len() < MAX_ACCOUNTS && state.logged.insert(problem.clone()) {
                tracing::warn!("{problem}");
            }
        }
        if problems.is_empty() {
            state.problems.remove(kind);
        } else if state.problems.len() < MAX_PROBLEMS || state.problems.contains_key(kind) {
            state.problems.insert(kind.to_owned(), problems);
        }
    }

    /// Problems of the process, each with its duration, as a message may hold them.
    pub fn problems(&self) -> Vec<String> {
        let state = self.lock();
        let problems = state.problems.values().flatten().take(MAX_PROBLEMS);
        let texts = problems.map(|(problem, since)| {
            let duration = format!(" (for {:.0} s)", since.elapsed().as_secs_f64());
            let room = MAX_MESSAGE_BYTES.saturating_sub(duration.len());
            printable(problem, room) + &duration
        });
        texts.collect()
    }

    /// Records the duration of a stage for one frame.
    pub fn timed(&self, stage: &str, time: Duration) {
        let mut state = self.lock();
        // The entry API would allocate the name at every call.
        if !state.stages.contains_key(stage) {
            state.stages.insert(stage.to_owned(), Timings::default());
        }
        let Some(timings) = state.stages.get_mut(stage) else {
            return;
        };
        timings.count += 1;
        timings.sum = timings.sum.saturating_add(time);
        // Upper bounds are inclusive, as the buckets of Prometheus are.
        let bucket = BUCKETS_S.partition_point(|end| *end < time.as_secs_f64());
        if let Some(count) = timings.buckets.get_mut(bucket) {
            *count += 1;
        }
        timings.max = timings.max.max(time);
        if timings.last.len() == KEPT_TIMINGS {
            timings.last.pop_front();
        }
        timings.last.push_back(time);
    }

    /// Counts the bytes of a message that the network has taken.
    pub(super) fn published(&self, topic: &Topic, bytes: usize) {
        let mut state = self.lock();
        if state.traffic.len() < MAX_ACCOUNTS || state.traffic.contains_key(topic) {
            let (messages, sum) = state.traffic.entry(topic.clone()).or_default();
            (*messages, *sum) = (*messages + 1, sum.saturating_add(bytes as u64));
        }
    }

    /// Published messages and bytes so far, by topic.
    pub fn traffic(&self) -> Vec<TopicTraffic> {
        let state = self.lock();
        let traffic = state.traffic.iter();
        let traffic = traffic.map(|(topic, &(messages, bytes))| TopicTraffic {
            topic: topic.clone(),
            messages,
            bytes,
        });
        traffic.collect()
    }

    /// Counts a tick of the scene.
    pub fn tick(&self) {
        self.lock().frames.ticks += 1;
    }

    /// Counts the detections of a frame; `latency` is the time from the publication of the tick to that of its
    /// detections, `None` if unknown here.
    pub fn answered(&self, latency: Option<Duration>, fused_neighbours: usize) {
        self.lock().frames.answer(latency, fused_neighbours);
    }

    /// Frames so far, from end to end.
    pub fn frames(&self) -> FrameStats {
        self.lock().frames.clone()
    }

    /// Current ledger. Messages submitted and not handed over, or arrived and not yet used or dropped, are in flight.
    pub fn ledger(&self) -> Ledger {
        let state = self.lock();
        let mut ledger = state.ledger.clone();
        for (account, counts) in state.ledger.iter() {
            let passed = state.passed.get(account).copied().unwrap_or(0);
            let in_flight = match account.to {
                // A sender drops what has not passed its queue, a receiver what has.
                None => counts.sent.saturating_sub(passed + counts.dropped_total()),
                Some(_) => passed.saturating_sub(counts.received + counts.dropped_total()),
            };
            ledger.set_in_flight(account, in_flight);
        }
        ledger
    }

    /// Summary of every stage over its most recent frames.
    pub fn stages(&self) -> Vec<StageSummary> {
        let state = self.lock();
        let summaries = state.stages.iter().map(|(stage, timings)| {
            let seconds = timings.last.iter().map(Duration::as_secs_f64);
            let ms: Vec<f64> = seconds.map(|seconds| seconds * 1e3).collect();
            let ms = sorted(&ms);
            let [p50_ms, p95_ms, p99_ms] =
                [0.50, 0.95, 0.99].map(|q| quantile(&ms, q).unwrap_or(0.0));
            StageSummary {
                stage: stage.clone(),
                count: timings.count,
                sum_ms: timings.sum.as_secs_f64() * 1e3,
                p50_ms,
                p95_ms,
                p99_ms,
                max_ms: timings.max.as_secs_f64() * 1e3,
            }
        });
        summaries.collect()
    }

    /// Histogram of every stage over all its frames.
    pub(crate) fn histograms(&self) -> Vec<StageHistogram> {
        let state = self.lock();
        let ends = BUCKETS_S.into_iter().chain([f64::MAX]);
        let histograms = state.stages.iter().map(|(stage, timings)| {
            let buckets: Vec<_> = ends.clone().zip(timings.buckets).collect();
            let sum_s = timings.sum.as_secs_f64();
            (stage.clone(), timings.count, sum_s, buckets)
        });
        histograms.collect()
    }

    fn note(&self, topic: &Topic, change: impl FnOnce(&mut CounterState)) {
        if topic.is_counted() {
            let mut state = self.lock();
            // Forged ids must not fill the memory, nor make a ledger that exceeds the limit of its receivers.
            if state.ledger.len() < MAX_ACCOUNTS || self.has_account(&state, topic) {
                change(&mut state);
            } else if !std::mem::replace(&mut state.is_full, true) {
                tracing::error!(%topic, "the ledger has {MAX_ACCOUNTS} accounts: messages on further topics are not counted");
            }
        }
    }

    fn note_published(&self, topic: &Topic, change: impl FnOnce(&mut CounterState, Account)) {
        self.note(topic, |state| {
            change(state, Account::published(topic.clone()))
        });
    }

    fn has_account(&self, state: &CounterState, topic: &Topic) -> bool {
        [self.here(topic), Account::published(topic.clone())]
            .iter()
            .any(|account| state.ledger.get(account).is_some())
    }

    fn here(&self, topic: &Topic) -> Account {
        Account::towards(topic.clone(), &self.process)
    }

    // Counters are changed in one step each: a panic elsewhere leaves them consistent.
    fn lock(&self) -> MutexGuard<'_, CounterState> {
        lock(&self.state)
    }
}

impl CounterState {
    fn peer(&mut self, cav: &CavId) -> Option<&mut Peer> {
        let has_room = self.peers.len() < MAX_PEERS || self.peers.contains_key(cav);
        has_room.then(|| self.peers.entry(cav.clone()).or_default())
    }

    fn pass(&mut self, account: Account, messages: u64) {
        *self.passed.entry(account).or_default() += messages;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn topic() -> Topic {
        "4279/bev".parse().unwrap()
    }

    #[test]
    fn a_problem_has_a_duration_and_ends() {
        let stats = stats_of("ego-1");
        let since = Instant::now().checked_sub(Duration::from_secs(12)).unwrap();
        stats.set_problems("no pose", [("no pose: too few points".into(), since)]);
        stats.set_problems("no sweep", [("no sweep".into(), since)]);
        assert_eq!(
            stats.problems(),
            ["no pose: too few points (for 12 s)", "no sweep (for 12 s)"]
        );
        stats.set_problems("no pose", None);
        assert_eq!(stats.problems(), ["no sweep (for 12 s)"]);
        let long = format!("no sweep:\n{}", "x".repeat(300));
        stats.set_problems("no sweep", [(long, since)]);
        let problem = stats.problems().remove(0);
        assert!(problem.starts_with("no sweep: xx") && problem.ends_with("x (for 12 s)"));
        assert_eq!(problem.len(), MAX_MESSAGE_BYTES, "messages hold no more");
    }

    fn stats_of(process: &str) -> MessageStats {
        MessageStats::new(process.parse().unwrap())
    }

    #[test]
    fn messages_in_queues_are_in_flight() {
        let (agent, ego) = (stats_of("agent-4279"), stats_of("ego-4279"));
        ego.subscribed(&topic());
        for _ in 0..5 {
            agent.submitted(&topic());
        }
        agent.suppressed(&topic(), DropReason::Superseded);
        agent.delivered(&topic());
        agent.delivered(&topic());
        ego.arrived(&topic());
        ego.arrived(&topic());
        ego.received(&topic());
        let mut ledger = agent.ledger();
        let published = Account::published(topic());
        assert_eq!(ledger.get(&published).unwrap().in_flight, 2);
        ledger.merge(&ego.ledger());
        assert!(ledger.balance().is_exact(), "{:?}", ledger.balance());
        ego.dropped(&topic(), DropReason::Stale);
        assert_eq!(
            ego.ledger()
                .get(&Account::towards(topic(), ego.process()))
                .unwrap()
                .in_flight,
            0
        );
    }

    #[test]
    fn repeated_messages_are_not_counted() {
        let agent = stats_of("agent-4279");
        let topic: Topic = "4279/descriptor".parse().unwrap();
        agent.submitted(&topic);
        agent.delivered(&topic);
        agent.rejected(
            &topic,
            &WireError::Kind {
                expected: protocol::Kind::Descriptor,
                found: protocol::Kind::Bev,
            },
        );
        assert!(agent.ledger().is_empty());
    }

    #[test]
    fn forged_ids_do_not_fill_the_ledger() {
        let stats = stats_of("ego-1");
        for id in 0..3 * MAX_ACCOUNTS {
            let topic: Topic = format!("{id}/bev").parse().unwrap();
            stats.subscribed(&topic);
            stats.arrived(&topic);
            stats.reject(&topic, DropReason::RateLimit, "too much");
        }
        assert_eq!(stats.ledger().len(), MAX_ACCOUNTS);
        let first: Topic = "0/bev".parse().unwrap();
        stats.received(&first);
        let account = Account::towards(first, stats.process());
        assert_eq!(
            stats.ledger().get(&account).unwrap().received,
            1,
            "existing accounts continue"
        );
        let state = stats.lock();
        assert!(state.rejections.len() <= MAX_ACCOUNTS + 1 && state.passed.len() <= MAX_ACCOUNTS);
    }

    #[test]
    fn stages_are_summed_up() {
        let stats = stats_of("ego");
        for ms in 1..=100 {
            stats.timed("fuse", Duration::from_millis(ms));
        }
        let stage = &stats.stages()[0];
        assert_eq!((stage.stage.as_str(), stage.count), ("fuse", 100));
        assert_eq!(
            (stage.p50_ms, stage.p95_ms, stage.p99_ms, stage.max_ms),
            (50.5, 95.05, 99.01, 100.0)
        );
    }
}
