//! All links of a scene.

use std::cmp::Reverse;
use std::collections::{BTreeMap, BinaryHeap};
use std::path::Path;

use protocol::{CavId, DropReason, Stream};

use super::capacity::Capacity;
use super::chance::{Chance, Purpose};
use super::config::{CapacityConfig, LinkConfig, LinkError, Medium};
use super::device_clock::DeviceClock;
use super::loss::{LossState, SentMessage};
use super::queue_server::{Departure, QueueServer, Rules};
use super::trace::Trace;
use support::nanos;
use support::random::derive_seed;

/// A message as the air sees it.
#[derive(Debug, Clone, PartialEq)]
pub struct Packet {
    /// The caller's name for it; the air does not look at it.
    pub id: u64,
    /// Who sends.
    pub from: CavId,
    /// Who shall receive.
    pub to: CavId,
    /// Which of the sender's streams.
    pub stream: Stream,
    /// Its number there.
    pub sequence: u64,
    /// Bytes on the wire, headers included.
    pub bytes: u64,
    /// When it is offered, nanoseconds since the beginning of the scene.
    pub offered_nanos: u64,
    /// Between sender and receiver at that time, metres.
    pub distance_m: f64,
}

/// What became of a parcel.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Delivery {
    /// It arrived.
    Arrived {
        /// Whether it had arrived before.
        is_copy: bool,
        /// Whether it will arrive once more.
        is_repeated: bool,
    },
    /// It did not.
    Dropped(DropReason),
}

/// A parcel, when its fate was known, and that fate.
#[derive(Debug, Clone, PartialEq)]
pub struct Outcome {
    /// Nanoseconds since the beginning of the scene: of the arrival or of the loss.
    pub nanos: u64,
    /// Which.
    pub parcel: Packet,
    /// What became of it.
    pub fate: Delivery,
}

/// The emulated air: parcels in, outcomes out, in the order of time.
#[derive(Debug)]
pub struct LinkEmulator {
    config: LinkConfig,
    capacity: Capacity,
    trace: Option<Trace>,
    seed: u64,
    lines: BTreeMap<Option<(CavId, CavId)>, QueueServer>,
    directions: BTreeMap<(CavId, CavId), Direction>,
    under_way: BinaryHeap<Reverse<UnderWay>>,
    outcomes: Vec<Outcome>,
    now_nanos: u64,
    /// Number of the next outcome, which settles the order of those at the same time.
    next: u64,
}

/// What is known of one direction between two vehicles.
#[derive(Debug)]
struct Direction {
    chance: Chance,
    loss: LossState,
    /// By stream: the latest arrival.
    latest_nanos: BTreeMap<Stream, u64>,
}

/// An outcome that lies ahead.
#[derive(Debug)]
struct UnderWay {
    nanos: u64,
    number: u64,
    parcel: Packet,
    fate: Delivery,
}

impl PartialEq for UnderWay {
    fn eq(&self, other: &Self) -> bool {
        (self.nanos, self.number) == (other.nanos, other.number)
    }
}

impl Eq for UnderWay {}

impl PartialOrd for UnderWay {
    fn partial_cmp(&self, other: &Self) -> Option<std::cmp::Ordering> {
        Some(self.cmp(other))
    }
}

impl Ord for UnderWay {
    fn cmp(&self, other: &Self) -> std::cmp::Ordering {
        (self.nanos, self.number).cmp(&(other.nanos, other.number))
    }
}

impl LinkEmulator {
    /// The air that a preset or a YAML file describes; paths of traces start at the file's folder.
    ///
    /// # Errors
    /// [`LinkError`] names the file and what is wrong with it.
    pub fn open(name: &str, seed: u64) -> Result<Self, LinkError> {
        let (config, folder) = LinkConfig::open(name)?;
        Self::new(config, &folder, seed).map_err(|source| LinkError::in_file(name, source))
    }

    /// The air of a configuration; paths of traces start at `folder`. The same seed gives the same air.
    ///
    /// # Errors
    /// [`LinkError`] names the field or the file that is wrong.
    pub fn new(config: LinkConfig, folder: &Path, seed: u64) -> Result<Self, LinkError> {
        config.validate()?;
        let trace = config.read_trace(folder)?;
        let capacity = Capacity::new(&config.capacity, trace.as_ref());
        Ok(Self {
            config,
            capacity,
            trace,
            seed,
            lines: BTreeMap::new(),
            directions: BTreeMap::new(),
            under_way: BinaryHeap::new(),
            outcomes: Vec::new(),
            now_nanos: 0,
            next: 0,
        })
    }

    /// The clock of those who send.
    #[must_use]
    pub fn clock(&self) -> &DeviceClock {
        &self.config.clock
    }

    /// Takes a message. Times never go back: one that is offered before the last one counts as offered with it.
    pub fn offer(&mut self, mut parcel: Packet) {
        parcel.offered_nanos = parcel.offered_nanos.max(self.now_nanos);
        self.run(parcel.offered_nanos);
        let key = match self.config.medium {
            Medium::Shared => None,
            Medium::PerPair => Some((parcel.from.clone(), parcel.to.clone())),
        };
        let mut left = Vec::new();
        let rules = rules(&self.config, &self.capacity);
        self.lines.entry(key).or_default().offer(parcel, &rules, &mut left);
        left.into_iter().for_each(|left| self.settle(left));
        self.collect(self.now_nanos);
    }

    /// Lets time pass until `nanos`; what became known by then comes back in the order of time.
    pub fn advance(&mut self, nanos: u64) -> Vec<Outcome> {
        self.run(nanos.max(self.now_nanos));
        std::mem::take(&mut self.outcomes)
    }

    /// When the next outcome can be known; none while nothing is under way.
    #[must_use]
    pub fn next_nanos(&self) -> Option<u64> {
        let rules = rules(&self.config, &self.capacity);
        let sent = self.lines.values().filter_map(|line| line.next_nanos(&rules));
        let known = self.outcomes.first().map(|outcome| outcome.nanos);
        let ahead = self.under_way.peek().map(|Reverse(under_way)| under_way.nanos);
        sent.chain(known).chain(ahead).min()
    }

    /// Lines first, in the order of time over all of them, then what arrives meanwhile.
    fn run(&mut self, until_nanos: u64) {
        loop {
            let rules = rules(&self.config, &self.capacity);
            let next = self.lines.iter_mut().filter_map(|(_, line)| Some((line.next_nanos(&rules)?, line)));
            let Some((nanos, line)) = next.min_by_key(|(nanos, _)| *nanos).filter(|(nanos, _)| *nanos <= until_nanos)
            else {
                break;
            };
            let mut left = Vec::new();
            line.advance(nanos, &rules, &mut left);
            left.into_iter().for_each(|left| self.settle(left));
        }
        self.now_nanos = until_nanos;
        self.collect(until_nanos);
    }

    fn collect(&mut self, until_nanos: u64) {
        while self.under_way.peek().is_some_and(|Reverse(under_way)| under_way.nanos <= until_nanos) {
            let Some(Reverse(UnderWay { nanos, parcel, fate, .. })) = self.under_way.pop() else { return };
            self.outcomes.push(Outcome { nanos, parcel, fate });
        }
    }

    /// Decides about a parcel that has left its queue.
    fn settle(&mut self, left: Departure) {
        match left {
            Departure::Dropped { parcel, reason, nanos } => self.schedule(nanos, parcel, Delivery::Dropped(reason)),
            Departure::Sent { parcel, start_nanos, end_nanos } => self.propagate(parcel, start_nanos, end_nanos),
        }
    }

    fn propagate(&mut self, parcel: Packet, start_nanos: u64, end_nanos: u64) {
        let Self { config, trace, seed, directions, .. } = self;
        let direction = directions.entry((parcel.from.clone(), parcel.to.clone())).or_insert_with(|| Direction {
            chance: Chance::new(*seed, &parcel.from, &parcel.to),
            loss: LossState::default(),
            latest_nanos: BTreeMap::new(),
        });
        let stream = label(parcel.stream);
        let random = |purpose| direction.chance.of(purpose, stream, parcel.sequence);
        let message = SentMessage { bytes: parcel.bytes, distance_m: parcel.distance_m, sent_nanos: end_nanos };
        let is_lost =
            direction.loss.loses(&config.loss, config.loss_unit, &message, trace.as_ref(), &mut random(Purpose::Loss));
        if is_lost || config.is_cut(start_nanos, end_nanos) {
            self.schedule(end_nanos, parcel, Delivery::Dropped(DropReason::LinkLoss));
            return;
        }
        let delay_nanos = config.delay.draw(&mut random(Purpose::Delay), trace.as_ref(), &message);
        // Nothing arrives before its last bit was sent, whatever the steps.
        let arrival_nanos = config.floored(parcel.offered_nanos, end_nanos.saturating_add(delay_nanos));
        let mut arrival_nanos = arrival_nanos.max(end_nanos);
        if config.keep_order {
            let latest = direction.latest_nanos.entry(parcel.stream).or_default();
            arrival_nanos = arrival_nanos.max(*latest);
            *latest = arrival_nanos;
        }
        if let Some(reorder) = config.reorder
            && random(Purpose::Reorder).chance(reorder.probability)
        {
            arrival_nanos = arrival_nanos.saturating_add(nanos::of_ms(reorder.extra_ms));
        }
        let mut twice = random(Purpose::Duplicate);
        if config.duplicate > 0.0 && twice.chance(config.duplicate) {
            let again_nanos = config.delay.draw(&mut twice, trace.as_ref(), &message);
            let copy_nanos = arrival_nanos.saturating_add(again_nanos);
            self.schedule(arrival_nanos, parcel.clone(), Delivery::Arrived { is_copy: false, is_repeated: true });
            self.schedule(copy_nanos, parcel, Delivery::Arrived { is_copy: true, is_repeated: false });
            return;
        }
        self.schedule(arrival_nanos, parcel, Delivery::Arrived { is_copy: false, is_repeated: false });
    }

    fn schedule(&mut self, nanos: u64, parcel: Packet, fate: Delivery) {
        self.under_way.push(Reverse(UnderWay { nanos, number: self.next, parcel, fate }));
        self.next += 1;
    }
}

impl LinkConfig {
    /// Whether an outage lies in a span.
    fn is_cut(&self, start_nanos: u64, end_nanos: u64) -> bool {
        let nanos = |seconds: f64| nanos::of_ms(1e3 * seconds);
        self.outages.iter().any(|outage| start_nanos < nanos(outage.to_s) && end_nanos >= nanos(outage.from_s))
    }

    /// Cuts the time since `offered_nanos` down to whole steps, where the link has them.
    fn floored(&self, offered_nanos: u64, arrival_nanos: u64) -> u64 {
        let took_nanos = arrival_nanos.saturating_sub(offered_nanos);
        match nanos::of_ms(self.floor_ms) {
            0 => arrival_nanos,
            step_nanos => offered_nanos + took_nanos / step_nanos * step_nanos,
        }
    }
}

fn rules<'a>(config: &'a LinkConfig, capacity: &'a Capacity) -> Rules<'a> {
    let burst_bytes = match config.capacity {
        CapacityConfig::TokenBucket { burst_bytes, .. } => burst_bytes,
        _ => 0,
    };
    Rules { capacity, burst_bytes, queue: &config.queue }
}

/// A number for a stream that stays the same whatever order the streams are listed in.
fn label(stream: Stream) -> u64 {
    derive_seed(0, &stream.to_string().bytes().map(u64::from).collect::<Vec<_>>())
}

#[cfg(test)]
mod tests;
