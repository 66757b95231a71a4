//! Link emulator: all links of a scene.

use std::collections::BTreeMap;
use std::path::Path;

use protocol::{CavId, DropReason, Stream};

use super::capacity::ServiceCurve;
use super::config::{CapacityConfig, LinkConfig, LinkError, Medium};
use super::device_clock::DeviceClock;
use super::loss::LossState;
use super::packet::Packet;
use super::queue_server::{Departure, QueueServer, Rules};
use super::trace::Trace;
use support::file_error::FileError;
use support::nanos;
use support::random::{SplitMix64, derive_seed};

/// Result for a packet.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Delivery {
    /// The packet arrived.
    Arrived {
        /// True if another copy arrived before.
        is_copy: bool,
        /// True if another copy will arrive.
        is_repeated: bool,
    },
    /// The packet was dropped.
    Dropped(DropReason),
}

/// A packet with its result and the time of the result.
#[derive(Debug, Clone, PartialEq)]
pub struct PacketOutcome {
    /// Time of the arrival or of the loss, nanoseconds since the beginning of the scene.
    pub nanos: u64,
    /// The packet.
    pub packet: Packet,
    /// Its result.
    pub delivery: Delivery,
}

/// Link emulator: packets in, outcomes out, in order of time.
#[derive(Debug)]
pub struct LinkEmulator {
    config: LinkConfig,
    rules: Rules,
    trace: Option<Trace>,
    seed: u64,
    lines: BTreeMap<Option<(CavId, CavId)>, QueueServer>,
    directions: BTreeMap<(CavId, CavId), DirectionState>,
    /// Future outcomes, by time and number.
    under_way: BTreeMap<(u64, u64), PacketOutcome>,
    outcomes: Vec<PacketOutcome>,
    now_nanos: u64,
    /// Number of the next outcome, which orders outcomes of the same time.
    next: u64,
}

/// Purpose of a random draw, which depends on the message and the purpose only, not on earlier decisions.
#[derive(Debug, Clone, Copy)]
enum Purpose {
    Delay = 1,
    Loss = 2,
    Reorder = 3,
    Duplicate = 4,
}

/// State of one direction between two vehicles.
#[derive(Debug)]
struct DirectionState {
    /// Seed of all its random numbers.
    seed: u64,
    loss: LossState,
    /// Latest arrival by stream, nanoseconds.
    latest_nanos: BTreeMap<Stream, u64>,
}

impl LinkEmulator {
    /// The emulator of a preset or a YAML file; paths of traces start at the file's folder.
    ///
    /// # Errors
    /// [`LinkError`] with the file and its fault.
    pub fn open(name: &str, seed: u64) -> Result<Self, LinkError> {
        let (config, folder) = LinkConfig::open(name)?;
        match Self::new(config, &folder, seed) {
            Err(LinkError::Value(error)) => Err(FileError::new(Path::new(name), error).into()),
            // Of a trace: names its own file.
            other => other,
        }
    }

    /// The emulator of a configuration; paths of traces start at `folder`. The same seed gives the same results.
    ///
    /// # Errors
    /// [`LinkError`] with the invalid field or file.
    pub fn new(config: LinkConfig, folder: &Path, seed: u64) -> Result<Self, LinkError> {
        config.validate()?;
        let trace = config.read_trace(folder)?;
        let rules = Rules {
            capacity: ServiceCurve::new(&config.capacity, trace.as_ref()),
            burst_bytes: match config.capacity {
                CapacityConfig::TokenBucket { burst_bytes, .. } => burst_bytes,
                _ => 0,
            },
            queue: config.queue,
        };
        Ok(Self {
            config,
            rules,
            trace,
            seed,
            lines: BTreeMap::new(),
            directions: BTreeMap::new(),
            under_way: BTreeMap::new(),
            outcomes: Vec::new(),
            now_nanos: 0,
            next: 0,
        })
    }

    /// The clock of the senders.
    pub fn clock(&self) -> &DeviceClock {
        &self.config.clock
    }

    /// Submits a packet. Time never goes back: a packet earlier than the last one counts as submitted with it.
    pub fn submit(&mut self, mut packet: Packet) {
        // Outcomes up to now may have been handed out: a packet in the past could change them.
        packet.submitted_nanos = packet.submitted_nanos.max(self.now_nanos);
        self.run(packet.submitted_nanos);
        let key = match self.config.medium {
            Medium::Shared => None,
            Medium::PerPair => Some((packet.from.clone(), packet.to.clone())),
        };
        let mut left = Vec::new();
        let line = self.lines.entry(key).or_default();
        line.submit(packet, &self.rules, &mut left);
        left.into_iter().for_each(|left| self.settle(left));
        // An unlimited link without delay delivers at once, and a full queue drops at once.
        self.collect(self.now_nanos);
    }

    /// Advances the time to `nanos`; returns the outcomes up to then in order of time.
    pub fn advance(&mut self, nanos: u64) -> Vec<PacketOutcome> {
        self.run(nanos.max(self.now_nanos));
        std::mem::take(&mut self.outcomes)
    }

    /// Time of the next outcome; `None` if nothing is in flight.
    pub fn next_nanos(&self) -> Option<u64> {
        let lines = self.lines.values();
        let sent = lines.filter_map(|line| line.next_nanos(&self.rules));
        // Outcomes that were collected but not fetched yet come before everything in flight.
        let known = self.outcomes.first().map(|outcome| outcome.nanos);
        let ahead = self.under_way.keys().next().map(|(nanos, _)| *nanos);
        sent.chain(known).chain(ahead).min()
    }

    /// Queues first, in order of time over all of them, then arrivals.
    fn run(&mut self, until_nanos: u64) {
        loop {
            let lines = self.lines.values_mut();
            let next = lines.filter_map(|line| Some((line.next_nanos(&self.rules)?, line)));
            let next = next.min_by_key(|(nanos, _)| *nanos);
            let Some((nanos, line)) = next.filter(|(nanos, _)| *nanos <= until_nanos) else {
                break;
            };
            let mut left = Vec::new();
            line.advance(nanos, &self.rules, &mut left);
            left.into_iter().for_each(|left| self.settle(left));
        }
        self.now_nanos = until_nanos;
        self.collect(until_nanos);
    }

    fn collect(&mut self, until_nanos: u64) {
        while let Some(first) = self.under_way.first_entry()
            && first.get().nanos <= until_nanos
        {
            self.outcomes.push(first.remove());
        }
    }

    /// Decides the result of a packet that has left its queue.
    fn settle(&mut self, left: Departure) {
        match left {
            // Queues drop on a submission only, which is now.
            Departure::Dropped(packet) => {
                let dropped = Delivery::Dropped(DropReason::LinkQueue);
                self.schedule(self.now_nanos, packet, dropped);
            }
            Departure::Sent(packet, sent_nanos) => self.propagate(packet, sent_nanos),
        }
    }

    fn propagate(&mut self, packet: Packet, [start_nanos, end_nanos]: [u64; 2]) {
        let config = &self.config;
        let step = self.trace.as_ref().and_then(|trace| trace.at(end_nanos));
        // By direction even on a shared medium: losses and order concern one pair of vehicles.
        let direction = self
            .directions
            .entry((packet.from.clone(), packet.to.clone()))
            .or_insert_with(|| DirectionState {
                // From names, not from indices: another vehicle does not change the draws of this pair.
                seed: derive_seed(
                    self.seed,
                    &[&packet.from, &packet.to].map(|cav| label(cav.as_str())),
                ),
                loss: LossState::default(),
                latest_nanos: BTreeMap::new(),
            });
        let (seed, stream) = (direction.seed, label(&packet.stream.to_string()));
        let (bytes, sequence) = (packet.bytes, packet.sequence);
        let random =
            |purpose: Purpose| SplitMix64::derived(seed, &[purpose as u64, stream, sequence]);
        // Drawn for every sent message, also during an outage: the Markov chain takes one step for each.
        let mut chance = random(Purpose::Loss);
        let is_lost = direction.loss.loses(config, &packet, step, &mut chance);
        if is_lost || config.is_cut(start_nanos, end_nanos) {
            self.schedule(end_nanos, packet, Delivery::Dropped(DropReason::LinkLoss));
            return;
        }
        let mut delay = random(Purpose::Delay);
        let delay_nanos = config.latency.draw(&mut delay, step, bytes);
        let exact_nanos = end_nanos.saturating_add(delay_nanos);
        // No packet arrives before its last bit was sent, also with rounding.
        let arrival_nanos = config.floored(packet.submitted_nanos, exact_nanos);
        let mut arrival_nanos = arrival_nanos.max(end_nanos);
        // A late message holds back those behind it in its stream, as in a transport that delivers in order.
        if config.keep_order {
            let latest = direction.latest_nanos.entry(packet.stream).or_default();
            arrival_nanos = arrival_nanos.max(*latest);
            *latest = arrival_nanos;
        }
        // Further delays are added to the time before rounding.
        let mut exact_nanos = exact_nanos.max(arrival_nanos);
        // After the order was kept, and not entered in `latest_nanos`: only this message is late.
        if let Some(reorder) = config.reorder
            && random(Purpose::Reorder).chance(reorder.probability)
        {
            exact_nanos = exact_nanos.saturating_add(nanos::of_ms(reorder.extra_ms));
            arrival_nanos = arrival_nanos.max(config.floored(packet.submitted_nanos, exact_nanos));
        }
        let mut twice = random(Purpose::Duplicate);
        // The delay of the copy has a stream of its own too, so that it differs from the first delay.
        let is_repeated = config.duplicate > 0.0 && twice.chance(config.duplicate);
        let copy_nanos = is_repeated.then(|| {
            let again_nanos = config.latency.draw(&mut twice, step, bytes);
            let exact_nanos = exact_nanos.saturating_add(again_nanos);
            arrival_nanos.max(config.floored(packet.submitted_nanos, exact_nanos))
        });
        let first = Delivery::Arrived {
            is_copy: false,
            is_repeated,
        };
        self.schedule(arrival_nanos, packet.clone(), first);
        if let Some(copy_nanos) = copy_nanos {
            let copy = Delivery::Arrived {
                is_copy: true,
                is_repeated: false,
            };
            self.schedule(copy_nanos, packet, copy);
        }
    }

    fn schedule(&mut self, nanos: u64, packet: Packet, delivery: Delivery) {
        let outcome = PacketOutcome {
            nanos,
            packet,
            delivery,
        };
        // The number keeps outcomes of the same time apart, in the order of their decisions.
        self.under_way.insert((nanos, self.next), outcome);
        self.next += 1;
    }
}

/// A number for a name that does not depend on the order in which names are listed.
fn label(name: &str) -> u64 {
    derive_seed(0, &name.bytes().map(u64::from).collect::<Vec<_>>())
}

impl LinkConfig {
    /// True if an outage lies in an interval.
    fn is_cut(&self, start_nanos: u64, end_nanos: u64) -> bool {
        self.outages.iter().any(|outage| {
            let [from, to] = [outage.from_s, outage.to_s].map(|s| nanos::of_ms(1e3 * s));
            // Half-open: a message that starts at the end of the outage passes.
            start_nanos < to && end_nanos >= from
        })
    }

    /// Rounds the time since `submitted_nanos` down to whole steps, if the link has them.
    fn floored(&self, submitted_nanos: u64, arrival_nanos: u64) -> u64 {
        let took_nanos = arrival_nanos.saturating_sub(submitted_nanos);
        match nanos::of_ms(self.floor_ms) {
            0 => arrival_nanos,
            step_nanos => submitted_nanos + took_nanos / step_nanos * step_nanos,
        }
    }
}

#[cfg(test)]
mod tests;
