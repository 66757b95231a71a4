//! Link process: link emulation between the agents of a live run and one ego.
//!
//! Messages of agents are received, kept until the [`LinkEmulator`] delivers them, and published unchanged, stamp
//! included, under `rx/<ego>/<cav>/<stream>`. One thread receives and decides; sending has its own threads.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;
use std::time::{Duration, Instant};

use protocol::{CavId, DropReason, Gnss, Limits, Role, Stream, Topic};
use serde::Serialize;

use bus::bounded_queue::Pop;
use bus::shutdown::Stop;
use bus::{
    Arrival, Bus, BusError, Event, Inbox, InboxLimits, Membership, Publisher, PublisherOptions,
    Subscription,
};
use link::{Delivery, LinkEmulator, Packet};
use support::nanos;

/// Messages of one topic that may wait for processing, and that may wait for forwarding.
const PLACES: usize = 64;
/// Largest number of vehicles of a link.
const MAX_VEHICLES: usize = 64;
/// Largest number of rejected vehicles that are remembered, so that the log reports each once.
const MAX_REJECTED: usize = 1024;
/// Messages in flight for longer than this at the end count as stuck, milliseconds.
const STUCK_MS: u64 = 5_000;
/// Interval at which the node checks the membership without incoming messages.
const MEMBERSHIP_PERIOD: Duration = Duration::from_millis(20);

/// Options of the link process.
#[derive(Debug, Clone)]
pub struct NodeOptions {
    /// The receiving ego.
    pub ego: CavId,
    /// Streams that are forwarded.
    pub streams: Vec<Stream>,
    /// True to continue when all agents have ended, for the next ones.
    pub keeps_running: bool,
    /// Largest number of bytes of kept messages: under a long delay the emulator itself has no limit.
    pub max_kept_bytes: u64,
    /// Limits per topic, and of messages that wait for processing.
    pub inbox: InboxLimits,
}

/// Message counters of the link.
#[derive(Debug, Clone, PartialEq, Eq, Default, Serialize)]
pub struct LinkReport {
    /// Messages from agents.
    pub submitted: u64,
    /// Of these, forwarded.
    pub arrived: u64,
    /// Forwarded a second time.
    pub copies: u64,
    /// Not forwarded, by reason.
    pub dropped: BTreeMap<DropReason, u64>,
    /// Still in flight at the end.
    pub under_way: u64,
    /// Longest time in flight of these, milliseconds.
    pub longest_ms: u64,
}

impl LinkReport {
    /// True if messages are still in flight only because the run has ended, and not because the link is stuck.
    pub fn is_complete(&self) -> bool {
        self.longest_ms <= STUCK_MS
    }
}

/// Forwards messages until all agents have ended and everything has arrived, or `stop` is requested.
///
/// # Errors
/// [`BusError`] if the bus fails. Faults of single messages are counted and logged.
pub fn run(
    bus: &Bus,
    emulator: LinkEmulator,
    options: &NodeOptions,
    stop: &Stop,
) -> Result<LinkReport, BusError> {
    let mut node = LinkNode::open(bus, emulator, options, stop)?;
    let presence = bus.announce(Role::Link)?;
    node.carry(stop)?;
    let mut report = node.report;
    let mut kept = node.kept;
    // A message that has arrived is not in flight, although its copy is.
    kept.retain(|id, _| !node.repeated.contains(id));
    for arrival in kept.values() {
        let age_ms = u64::try_from(arrival.at.elapsed().as_millis()).unwrap_or(u64::MAX);
        report.under_way += 1;
        report.longest_ms = report.longest_ms.max(age_ms);
        // Messages that would have arrived after the end are in flight, those of a link that is stuck are lost.
        if age_ms > STUCK_MS {
            bus.stats().dropped(&arrival.topic, DropReason::Stale);
        }
    }
    let vehicles = node.vehicles.into_values();
    vehicles
        .flat_map(|vehicle| vehicle.publishers.into_values())
        .for_each(Publisher::finish);
    presence.withdraw()?;
    Ok(report)
}

/// One agent, or the ego, of which only the position is used.
#[derive(Default)]
struct LinkVehicle {
    publishers: BTreeMap<Stream, Publisher>,
    /// Streams that have ended.
    ended: BTreeSet<Stream>,
    position_m: Option<[f64; 3]>,
    /// True if it has left: a new vehicle may replace it.
    has_left: bool,
    _subscriptions: Vec<Subscription>,
}

struct LinkNode<'a> {
    bus: &'a Bus,
    emulator: LinkEmulator,
    options: &'a NodeOptions,
    inbox: Arc<Inbox>,
    membership: Membership,
    vehicles: BTreeMap<CavId, LinkVehicle>,
    /// Vehicles rejected because all slots are taken.
    rejected: BTreeSet<CavId>,
    /// Messages in flight, by id.
    kept: BTreeMap<u64, Arrival>,
    /// Ids of those that have arrived, and whose copy is in flight.
    repeated: BTreeSet<u64>,
    /// Total bytes of the kept messages.
    kept_bytes: u64,
    next_id: u64,
    /// Time of arrival of the first message: time 0 of the emulator.
    began: Option<Instant>,
    /// Capture time of the first message, from which clocks drift.
    began_nanos: Option<u64>,
    report: LinkReport,
}

impl<'a> LinkNode<'a> {
    fn open(
        bus: &'a Bus,
        emulator: LinkEmulator,
        options: &'a NodeOptions,
        stop: &Stop,
    ) -> Result<Self, BusError> {
        // One topic more per vehicle than streams: its GNSS.
        let topics = MAX_VEHICLES * (options.streams.len() + 1);
        let inbox = bus.limited_inbox(PLACES, topics, options.inbox);
        let closed = Arc::clone(&inbox);
        stop.on_request(move || closed.close());
        let membership = Membership::begin(bus, Role::Agent, 2 * MAX_VEHICLES)?;
        Ok(Self {
            bus,
            emulator,
            options,
            inbox,
            membership,
            vehicles: BTreeMap::new(),
            rejected: BTreeSet::new(),
            kept: BTreeMap::new(),
            repeated: BTreeSet::new(),
            kept_bytes: 0,
            next_id: 0,
            began: None,
            began_nanos: None,
            report: LinkReport::default(),
        })
    }

    fn carry(&mut self, stop: &Stop) -> Result<(), BusError> {
        let _working = self.bus.works_from(&self.inbox);
        while !stop.requested() {
            self.update_membership()?;
            match self.inbox.take(Some(self.next_moment())) {
                Pop::Item(Topic::Stream { cav, stream }, Event::Message(arrival)) => match stream {
                    // GNSS is only read here, for losses that depend on distance. It is not forwarded.
                    Stream::Gnss => self.locate(&cav, &arrival),
                    _ => self.admit(cav, stream, arrival),
                },
                Pop::Item(Topic::Stream { cav, stream }, Event::End { .. }) => {
                    if let Some(vehicle) = self.vehicles.get_mut(&cav) {
                        vehicle.ended.insert(stream);
                    }
                }
                Pop::Item(..) | Pop::TimedOut => {}
                Pop::Closed => break,
            }
            self.settle();
            if self.is_over() {
                break;
            }
        }
        Ok(())
    }

    fn is_over(&self) -> bool {
        let options = self.options;
        let vehicles = self.vehicles.iter();
        let mut senders = vehicles.filter(|(cav, _)| **cav != options.ego).peekable();
        !options.keeps_running
            // Before the first sender joins, none can have ended.
            && senders.peek().is_some()
            && senders.all(|(_, vehicle)| {
                let mut streams = options.streams.iter();
                streams.all(|stream| vehicle.ended.contains(stream))
            })
            && self.kept.is_empty()
    }

    /// Processes vehicles that joined or left.
    fn update_membership(&mut self) -> Result<(), BusError> {
        while let Some((cav, is_there)) = self.membership.next() {
            match self.vehicles.get_mut(&cav) {
                Some(vehicle) if is_there => {
                    // It was offline and sends again.
                    vehicle.ended.clear();
                    vehicle.has_left = false;
                }
                Some(vehicle) => {
                    // Its earlier messages may still be in flight.
                    vehicle.ended.extend(self.options.streams.iter().copied());
                    vehicle.has_left = true;
                }
                None if is_there => self.add(cav)?,
                None => {}
            }
        }
        Ok(())
    }

    /// Adds a new vehicle; if all slots are taken, it replaces one that has left.
    fn add(&mut self, cav: CavId) -> Result<(), BusError> {
        if self.vehicles.len() >= MAX_VEHICLES {
            let kept = self.kept.values().map(|arrival| &arrival.header.stamp.cav);
            let senders: BTreeSet<&CavId> = kept.collect();
            let gone = place_to_free(&self.vehicles, &self.options.ego, &senders);
            let Some(gone) = gone.cloned() else {
                if self.rejected.len() < MAX_REJECTED && self.rejected.insert(cav.clone()) {
                    tracing::warn!(%cav, "its messages are not forwarded: the link carries at most {MAX_VEHICLES} vehicles");
                }
                return Ok(());
            };
            self.vehicles.remove(&gone);
        }
        let vehicle = self.attach(&cav)?;
        tracing::info!(%cav, "its messages are forwarded");
        self.vehicles.insert(cav, vehicle);
        Ok(())
    }

    fn attach(&self, cav: &CavId) -> Result<LinkVehicle, BusError> {
        let gnss = Topic::stream(cav, Stream::Gnss);
        let mut subscriptions = vec![self.bus.subscribe(gnss, &self.inbox)?];
        let mut publishers = BTreeMap::new();
        // The link does not apply to the ego's own agent.
        let is_ego = *cav == self.options.ego;
        for &stream in self.options.streams.iter().filter(|_| !is_ego) {
            let topic = Topic::stream(cav, stream);
            subscriptions.push(self.bus.subscribe(topic, &self.inbox)?);
            let topic = Topic::Received {
                ego: self.options.ego.clone(),
                cav: cav.clone(),
                stream,
            };
            let how = match stream {
                Stream::Pose => PublisherOptions::POSE,
                _ => PublisherOptions::FEATURES,
            };
            // The emulator decides the losses; forwarding is lossless.
            publishers.insert(stream, self.bus.publisher(topic, how.waiting(PLACES))?);
        }
        Ok(LinkVehicle {
            publishers,
            _subscriptions: subscriptions,
            ..LinkVehicle::default()
        })
    }

    /// Records the position of a vehicle: loss may depend on distance.
    fn locate(&mut self, cav: &CavId, arrival: &Arrival) {
        let Some(gnss) = self.inbox.decode::<Gnss>(arrival, &Limits::DEFAULT) else {
            return;
        };
        self.bus.stats().received(&arrival.topic);
        if let Some(vehicle) = self.vehicles.get_mut(cav) {
            vehicle.position_m = Some(gnss.world_from_lidar.translation_m);
        }
    }

    fn admit(&mut self, from: CavId, stream: Stream, arrival: Arrival) {
        let began = *self.began.get_or_insert(arrival.at);
        let distance_m = self.distance_m(&from);
        self.report.submitted += 1;
        let Some(vehicle) = self.vehicles.get_mut(&from) else {
            // It has left, and another vehicle has replaced it.
            return self.lose(&arrival, DropReason::PeerOffline);
        };
        // The end was that of the previous process instance; it can arrive after the first message of the new one.
        vehicle.ended.remove(&stream);
        if self.kept_bytes.saturating_add(arrival.wire_bytes()) > self.options.max_kept_bytes {
            return self.lose(&arrival, DropReason::LinkQueue);
        }
        self.kept_bytes += arrival.wire_bytes();
        self.emulator.submit(Packet {
            id: self.next_id,
            from,
            to: self.options.ego.clone(),
            stream,
            sequence: arrival.header.stamp.sequence,
            bytes: arrival.wire_bytes(),
            // Counted from its arrival at this process, so that the wait in the inbox is part of the delay.
            submitted_nanos: nanos::between(began, arrival.at),
            distance_m,
        });
        self.kept.insert(self.next_id, arrival);
        self.next_id += 1;
    }

    /// Distance between a sender and the ego, metres.
    fn distance_m(&self, from: &CavId) -> f64 {
        Packet::distance_m([from, &self.options.ego].map(|cav| self.vehicles.get(cav)?.position_m))
    }

    /// Forwards the messages that have arrived by now.
    fn settle(&mut self) {
        let Some(began) = self.began else { return };
        let now_nanos = nanos::between(began, Instant::now());
        for outcome in self.emulator.advance(now_nanos) {
            let packet = outcome.packet;
            match outcome.delivery {
                Delivery::Dropped(reason) => {
                    if let Some(lost) = self.release(packet.id) {
                        self.lose(&lost, reason);
                    }
                }
                Delivery::Arrived {
                    is_copy,
                    is_repeated,
                } => self.forward(&packet, is_copy, is_repeated),
            }
        }
    }

    fn forward(&mut self, packet: &Packet, is_copy: bool, is_repeated: bool) {
        let vehicle = self.vehicles.get(&packet.from);
        let publisher = vehicle.and_then(|vehicle| vehicle.publishers.get(&packet.stream));
        let (Some(publisher), Some(arrival)) = (publisher, self.kept.get(&packet.id)) else {
            return;
        };
        match arrival.header.stamp.capture_nanos {
            // A message without capture time.
            0 => publisher.relay(arrival),
            scene_nanos => {
                // A wrong clock of the senders drifts from the first message on.
                let began_nanos = *self.began_nanos.get_or_insert(scene_nanos);
                let clock = self.emulator.clock();
                publisher.relay_as(arrival, clock.shown_since(began_nanos, scene_nanos));
            }
        }
        if is_copy {
            self.report.copies += 1;
        } else {
            self.report.arrived += 1;
            self.bus.stats().received(&arrival.topic);
        }
        // A message that arrives twice is kept until its copy is sent.
        if is_repeated {
            self.repeated.insert(packet.id);
        } else {
            self.repeated.remove(&packet.id);
            self.release(packet.id);
        }
    }

    /// Counts a message that is not forwarded.
    fn lose(&mut self, arrival: &Arrival, reason: DropReason) {
        *self.report.dropped.entry(reason).or_default() += 1;
        self.bus.stats().dropped(&arrival.topic, reason);
    }

    /// Removes a kept message.
    fn release(&mut self, id: u64) -> Option<Arrival> {
        let released = self.kept.remove(&id)?;
        self.kept_bytes = self.kept_bytes.saturating_sub(released.wire_bytes());
        Some(released)
    }

    fn next_moment(&self) -> Instant {
        let soon = Instant::now() + MEMBERSHIP_PERIOD;
        let next = self.began.zip(self.emulator.next_nanos());
        next.map_or(soon, |(began, nanos)| {
            soon.min(began + Duration::from_nanos(nanos))
        })
    }
}

/// A vehicle that has left and is not among the `senders` of messages in flight; never the ego, whose position is
/// needed.
fn place_to_free<'v>(
    vehicles: &'v BTreeMap<CavId, LinkVehicle>,
    ego: &CavId,
    senders: &BTreeSet<&CavId>,
) -> Option<&'v CavId> {
    vehicles
        .iter()
        .find(|(cav, vehicle)| vehicle.has_left && *cav != ego && !senders.contains(*cav))
        .map(|(cav, _)| cav)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_slot_of_a_vehicle_that_has_left_is_free() {
        let cavs = ["0", "1", "2", "3"].map(|id| CavId::new(id).unwrap());
        let [ego, on_its_way, gone, present] = &cavs;
        let mut vehicles = BTreeMap::new();
        for cav in &cavs {
            let vehicle = LinkVehicle {
                publishers: BTreeMap::new(),
                ended: BTreeSet::new(),
                position_m: None,
                has_left: cav != present,
                _subscriptions: Vec::new(),
            };
            vehicles.insert(cav.clone(), vehicle);
        }
        let senders = BTreeSet::from([on_its_way]);
        assert_eq!(place_to_free(&vehicles, ego, &senders), Some(gone));
        vehicles.remove(gone);
        assert_eq!(place_to_free(&vehicles, ego, &senders), None);
    }
}
