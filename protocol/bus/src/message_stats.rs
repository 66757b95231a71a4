//! The ledger of one process, shared by its threads, and how long its stages take.

use std::collections::{BTreeMap, VecDeque};
use std::fmt;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use protocol::{Account, CavId, DropReason, Ledger, Limits, ProcessId, RateReason, StageSummary, Topic, WireError};

use support::statistics::{quantile, sorted};

use super::clock_offset::ClockOffset;

/// Accounts of one process, as many as whoever receives a ledger takes.
const MAX_ACCOUNTS: usize = Limits::DEFAULT.max_entries;
/// Vehicles whose clock and standing are remembered at most.
const MAX_PEERS: usize = 128;
/// Timings kept per stage: at 10 Hz the last three minutes.
const KEPT_TIMINGS: usize = 2048;

/// The books of one process. Cloning shares them. What is not booked ([`Topic::is_booked`]) leaves no trace in them.
#[derive(Clone)]
pub struct MessageStats {
    process: ProcessId,
    state: Arc<Mutex<State>>,
}

#[derive(Default)]
struct State {
    ledger: Ledger,
    // How many messages of an account have come as far as this process takes them: out of a sender's queue onto the
    // network, or from the network into a receiver's. What lies between is in flight.
    passed: BTreeMap<Account, u64>,
    // Unsound messages, of whatever kind of topic.
    refused: BTreeMap<Topic, u64>,
    stages: BTreeMap<String, Timings>,
    peers: BTreeMap<CavId, Peer>,
    is_full: bool,
}

#[derive(Default)]
struct Peer {
    clock: Option<ClockOffset>,
    trust: Option<f64>,
}

/// What a process makes of a vehicle that it hears.
#[derive(Debug, Clone, PartialEq)]
pub struct PeerSummary {
    /// The vehicle.
    pub cav: CavId,
    /// Its clock less ours, seconds, less the shortest time a message of it was under way.
    pub clock_offset_s: Option<f64>,
    /// How far it is believed, 0..1; only where somebody asks.
    pub trust: Option<f64>,
}

/// Upper ends of the histogram's buckets, seconds: from a checksum to a lost cause.
const BUCKETS_S: [f64; 14] =
    [0.0001, 0.00025, 0.0005, 0.001, 0.0025, 0.005, 0.01, 0.025, 0.05, 0.1, 0.25, 0.5, 1.0, 2.5];

/// How long a stage took, over all frames so far.
#[derive(Debug, Clone, PartialEq)]
pub struct StageHistogram {
    /// Its name.
    pub stage: String,
    /// Frames.
    pub count: u64,
    /// All of their times, seconds.
    pub sum_s: f64,
    /// Upper end in seconds and number of frames of every bucket; the last has none ([`f64::MAX`]).
    pub buckets: Vec<(f64, u64)>,
}

#[derive(Default)]
struct Timings {
    count: u64,
    sum: Duration,
    buckets: [u64; BUCKETS_S.len() + 1],
    max: Duration,
    last: VecDeque<Duration>,
}

impl MessageStats {
    /// Empty books of `process`.
    #[must_use]
    pub fn new(process: ProcessId) -> Self {
        Self { process, state: Arc::default() }
    }

    /// Whose books these are.
    #[must_use]
    pub fn process(&self) -> &ProcessId {
        &self.process
    }

    /// This process offers one more message on `topic`.
    pub fn offered(&self, topic: &Topic) {
        self.note(topic, |state| state.ledger.sent(&Account::published(topic.clone())));
    }

    /// The network has taken a message that was offered.
    pub fn delivered(&self, topic: &Topic) {
        self.note(topic, |state| state.pass(Account::published(topic.clone())));
    }

    /// A message that was offered will not be sent.
    pub fn withheld(&self, topic: &Topic, reason: DropReason) {
        self.note(topic, |state| state.ledger.dropped(&Account::published(topic.clone()), reason));
    }

    /// A map that is offered was written so that it keeps within a limit.
    pub fn adapted(&self, topic: &Topic, reason: RateReason) {
        self.note(topic, |state| state.ledger.adapted(&Account::published(topic.clone()), reason));
    }

    /// This process listens to `topic` from now on.
    pub fn subscribed(&self, topic: &Topic) {
        self.note(topic, |state| state.ledger.open(&self.here(topic)));
    }

    /// The network has delivered a message, sound or not.
    pub fn arrived(&self, topic: &Topic) {
        self.note(topic, |state| state.pass(self.here(topic)));
    }

    /// A message that arrived was used.
    pub fn received(&self, topic: &Topic) {
        self.note(topic, |state| state.ledger.received(&self.here(topic)));
    }

    /// A message that arrived was not used.
    pub fn dropped(&self, topic: &Topic, reason: DropReason) {
        self.note(topic, |state| state.ledger.dropped(&self.here(topic), reason));
    }

    /// A message that arrived is unsound: counted always, logged ever more rarely, as a hostile peer must not fill the
    /// log.
    pub fn rejected(&self, topic: &Topic, error: &WireError) {
        self.refused(topic, error.drop_reason(), error);
    }

    /// A message that arrived is more than its topic may bring; counted and logged like an unsound one.
    pub(super) fn limited(&self, topic: &Topic, why: &'static str) {
        self.refused(topic, DropReason::RateLimit, &why);
    }

    /// The same of a notice: logged alone, as no sender counts what it says about itself.
    pub(super) fn limited_notice(&self, topic: &Topic, why: &'static str) {
        self.warn_once(topic, DropReason::RateLimit, &why);
    }

    /// A sound message says what is not its sender's to say; counted and logged like an unsound one.
    pub(super) fn reject_invalid(&self, topic: &Topic, why: &'static str) {
        self.refused(topic, DropReason::Identity, &why);
    }

    fn refused(&self, topic: &Topic, reason: DropReason, why: &dyn fmt::Display) {
        self.dropped(topic, reason);
        self.warn_once(topic, reason, why);
    }

    fn warn_once(&self, topic: &Topic, reason: DropReason, why: &dyn fmt::Display) {
        let times = {
            let mut state = self.lock();
            let has_room = state.refused.len() < MAX_ACCOUNTS || state.refused.contains_key(topic);
            let times = state.refused.entry(if has_room { topic.clone() } else { Topic::Truth }).or_default();
            *times += 1;
            *times
        };
        if times.is_power_of_two() {
            tracing::warn!(%topic, %reason, times, "message refused: {why}");
        }
    }

    /// A message of `cav` came: what that says of its clock. Said in the log when it is far off, and when it is not any more.
    pub(super) fn heard_clock(&self, cav: &CavId, sent_nanos: u64, arrived_nanos: u64, at: Instant) {
        let news = self.lock().peer(cav).and_then(|peer| {
            let clock = peer.clock.get_or_insert_with(|| ClockOffset::new(at));
            Some((clock.note(sent_nanos, arrived_nanos, at)?, clock.seconds()))
        });
        match news {
            Some((true, offset_s)) => tracing::warn!(%cav, offset_s, "its clock is far from ours"),
            Some((false, offset_s)) => tracing::info!(%cav, offset_s, "its clock is near ours again"),
            None => {}
        }
    }

    /// How far a vehicle is believed from now on, 0..1.
    pub fn trusted(&self, cav: &CavId, trust: f64) {
        if let Some(peer) = self.lock().peer(cav) {
            peer.trust = Some(trust);
        }
    }

    /// What is known of the vehicles that are heard.
    #[must_use]
    pub fn peers(&self) -> Vec<PeerSummary> {
        let summary = |(cav, peer): (&CavId, &Peer)| PeerSummary {
            cav: cav.clone(),
            clock_offset_s: peer.clock.as_ref().map(ClockOffset::seconds),
            trust: peer.trust,
        };
        self.lock().peers.iter().map(summary).collect()
    }

    /// A stage took this long for one frame.
    pub fn timed(&self, stage: &str, time: Duration) {
        let mut state = self.lock();
        if !state.stages.contains_key(stage) {
            state.stages.insert(stage.to_owned(), Timings::default());
        }
        let Some(timings) = state.stages.get_mut(stage) else { return };
        timings.count += 1;
        timings.sum = timings.sum.saturating_add(time);
        timings.buckets[BUCKETS_S.partition_point(|end| *end < time.as_secs_f64())] += 1;
        timings.max = timings.max.max(time);
        if timings.last.len() == KEPT_TIMINGS {
            timings.last.pop_front();
        }
        timings.last.push_back(time);
    }

    /// The ledger as of now. What has been offered and not handed over, or has arrived and not been used or dropped,
    /// is in flight.
    #[must_use]
    pub fn ledger(&self) -> Ledger {
        let state = self.lock();
        let mut ledger = state.ledger.clone();
        for (account, counts) in state.ledger.iter() {
            let passed = state.passed.get(account).copied().unwrap_or(0);
            let in_flight = match account.to {
                None => counts.sent.saturating_sub(passed + counts.dropped_total()),
                Some(_) => passed.saturating_sub(counts.received + counts.dropped_total()),
            };
            ledger.set_in_flight(account, in_flight);
        }
        ledger
    }

    /// Every stage over its most recent frames.
    #[must_use]
    pub fn stages(&self) -> Vec<StageSummary> {
        let state = self.lock();
        state.stages.iter().map(|(stage, timings)| timings.summary(stage)).collect()
    }

    /// Every stage over all its frames.
    #[must_use]
    pub fn histograms(&self) -> Vec<StageHistogram> {
        let state = self.lock();
        let ends = || BUCKETS_S.into_iter().chain([f64::MAX]);
        let histogram = |(stage, timings): (&String, &Timings)| StageHistogram {
            stage: stage.clone(),
            count: timings.count,
            sum_s: timings.sum.as_secs_f64(),
            buckets: ends().zip(timings.buckets).collect(),
        };
        state.stages.iter().map(histogram).collect()
    }

    fn note(&self, topic: &Topic, change: impl FnOnce(&mut State)) {
        if topic.is_booked() {
            let mut state = self.lock();
            // Invented ids must not fill the memory, nor make a ledger that nobody takes.
            if state.ledger.len() < MAX_ACCOUNTS || self.knows(&state, topic) {
                change(&mut state);
            } else if !std::mem::replace(&mut state.is_full, true) {
                tracing::error!(%topic, "the ledger has {MAX_ACCOUNTS} accounts: what comes on further topics is not counted");
            }
        }
    }

    fn knows(&self, state: &State, topic: &Topic) -> bool {
        [self.here(topic), Account::published(topic.clone())].iter().any(|account| state.ledger.get(account).is_some())
    }

    fn here(&self, topic: &Topic) -> Account {
        Account::towards(topic.clone(), &self.process)
    }

    // Counters are changed in one step each: a panic elsewhere leaves them sound.
    fn lock(&self) -> MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl State {
    fn peer(&mut self, cav: &CavId) -> Option<&mut Peer> {
        if self.peers.len() >= MAX_PEERS && !self.peers.contains_key(cav) {
            return None;
        }
        Some(self.peers.entry(cav.clone()).or_default())
    }

    fn pass(&mut self, account: Account) {
        *self.passed.entry(account).or_default() += 1;
    }
}

impl Timings {
    fn summary(&self, stage: &str) -> StageSummary {
        let ms: Vec<f64> = self.last.iter().map(|time| time.as_secs_f64() * 1e3).collect();
        let ms = sorted(&ms);
        let quantile_ms = |q: f64| quantile(&ms, q).unwrap_or(0.0);
        StageSummary {
            stage: stage.to_owned(),
            count: self.count,
            p50_ms: quantile_ms(0.50),
            p95_ms: quantile_ms(0.95),
            p99_ms: quantile_ms(0.99),
            max_ms: self.max.as_secs_f64() * 1e3,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn topic() -> Topic {
        "4279/bev".parse().unwrap()
    }

    fn books(process: &str) -> MessageStats {
        MessageStats::new(process.parse().unwrap())
    }

    #[test]
    fn what_lies_between_is_in_flight() {
        let (agent, ego) = (books("agent-4279"), books("ego-4279"));
        ego.subscribed(&topic());
        for _ in 0..5 {
            agent.offered(&topic());
        }
        agent.withheld(&topic(), DropReason::Superseded);
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
        assert_eq!(ego.ledger().get(&Account::towards(topic(), ego.process())).unwrap().in_flight, 0);
    }

    #[test]
    fn what_is_said_again_and_again_is_not_booked() {
        let agent = books("agent-4279");
        let topic: Topic = "4279/descriptor".parse().unwrap();
        agent.offered(&topic);
        agent.delivered(&topic);
        agent.rejected(&topic, &WireError::Kind { expected: protocol::Kind::Descriptor, found: protocol::Kind::Bev });
        assert!(agent.ledger().is_empty());
    }

    #[test]
    fn invented_ids_do_not_fill_the_books() {
        let books = books("ego-1");
        let topic = |id: usize| format!("{id}/bev").parse::<Topic>().unwrap();
        for id in 0..3 * MAX_ACCOUNTS {
            books.subscribed(&topic(id));
            books.arrived(&topic(id));
            books.limited(&topic(id), "too much");
        }
        assert_eq!(books.ledger().len(), MAX_ACCOUNTS);
        books.received(&topic(0));
        let account = Account::towards(topic(0), books.process());
        assert_eq!(books.ledger().get(&account).unwrap().received, 1, "those that are there go on");
        let state = books.lock();
        assert!(state.refused.len() <= MAX_ACCOUNTS + 1 && state.passed.len() <= MAX_ACCOUNTS);
    }

    #[test]
    fn stages_are_summed_up() {
        let books = books("ego");
        for ms in 1..=100 {
            books.timed("fuse", Duration::from_millis(ms));
        }
        let stage = &books.stages()[0];
        assert_eq!((stage.stage.as_str(), stage.count), ("fuse", 100));
        assert_eq!((stage.p50_ms, stage.p95_ms, stage.p99_ms, stage.max_ms), (50.5, 95.05, 99.01, 100.0));
    }
}
