//! The air between the agents of a live run and one ego.
//!
//! What agents publish is taken in as it comes, kept for as long as the [`LinkEmulator`] says, and published under
//! `rx/<ego>/<cav>/<stream>` as it was, stamp and all. One thread receives and decides; sending has threads of its own.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;
use std::time::{Duration, Instant};

use protocol::{CavId, DropReason, Gnss, Limits, Role, Stream, Topic};
use serde::Serialize;

use bus::bounded_queue::Pop;
use bus::shutdown::Stop;
use bus::{Arrival, Bus, BusError, Event, Inbox, InboxLimits, Membership, Publisher, PublisherOptions, Subscription};
use link::{Delivery, LinkEmulator, Outcome, Packet};
use support::nanos;

/// Messages of one topic that may wait to be looked at, and that may wait to be passed on.
const PLACES: usize = 64;
/// Vehicles that a link carries at most.
const MAX_VEHICLES: usize = 64;
/// Vehicles that are remembered for having been turned away, so that the log names each once.
const MAX_TURNED_AWAY: usize = 1024;
/// Messages that are under way for longer at the end are of no use to anybody any more, milliseconds.
const STUCK_MS: u64 = 5_000;
/// How often the node looks for newcomers though nothing happens.
const LOOK_ROUND: Duration = Duration::from_millis(20);

/// What a link carries.
#[derive(Debug, Clone)]
pub struct NodeOptions {
    /// Who receives.
    pub ego: CavId,
    /// What agents send.
    pub streams: Vec<Stream>,
    /// Whether to go on when all agents have ended, for the next ones.
    pub keeps_running: bool,
    /// Bytes of messages that are kept at most: under a long delay the air itself has no bound.
    pub max_kept_bytes: u64,
    /// What each topic may bring, and what may wait to be looked at.
    pub inbox: InboxLimits,
}

impl NodeOptions {
    /// Until all agents of a run have ended, with at most 1 GiB on the way.
    #[must_use]
    pub const fn new(ego: CavId, streams: Vec<Stream>) -> Self {
        Self { ego, streams, keeps_running: false, max_kept_bytes: 1 << 30, inbox: InboxLimits::PEERS }
    }
}

/// What became of the messages.
#[derive(Debug, Clone, PartialEq, Eq, Default, Serialize)]
pub struct LinkReport {
    /// Messages that agents sent.
    pub offered: u64,
    /// Of these, passed on.
    pub arrived: u64,
    /// Passed on a second time.
    pub copies: u64,
    /// Not passed on.
    pub dropped: BTreeMap<DropReason, u64>,
    /// Still under way at the end.
    pub under_way: u64,
    /// For how long the oldest of these was, milliseconds.
    pub longest_ms: u64,
}

impl LinkReport {
    /// Whether what is still under way is so because the run has ended, and not because the link carries nothing.
    #[must_use]
    pub fn is_complete(&self) -> bool {
        self.longest_ms <= STUCK_MS
    }
}

/// Carries messages until all agents have ended and everything has arrived, or `stop` is requested.
///
/// # Errors
/// [`BusError`] when the bus refuses. What is wrong with single messages is counted and logged.
pub fn run(bus: &Bus, air: LinkEmulator, options: &NodeOptions, stop: &Stop) -> Result<LinkReport, BusError> {
    let mut node = Node::open(bus, air, options, stop)?;
    let presence = bus.announce(Role::Link)?;
    node.carry(stop)?;
    let Node { vehicles, kept, mut report, .. } = node;
    report.under_way = kept.len() as u64;
    let longest = kept.values().map(|arrival| arrival.at.elapsed()).max().unwrap_or_default();
    report.longest_ms = u64::try_from(longest.as_millis()).unwrap_or(u64::MAX);
    for topic in kept.values().map(|arrival| &arrival.topic) {
        bus.books().dropped(topic, DropReason::Stale);
    }
    vehicles.into_values().flat_map(|vehicle| vehicle.publishers.into_values()).for_each(Publisher::finish);
    presence.withdraw()?;
    Ok(report)
}

/// One agent, or the ego, of whom only the place is of interest.
struct Vehicle {
    publishers: BTreeMap<Stream, Publisher>,
    /// Streams that have ended.
    ended: BTreeSet<Stream>,
    position_m: Option<[f64; 3]>,
    /// Whether it has vanished: a newcomer may have its place.
    is_gone: bool,
    _subscriptions: Vec<Subscription>,
}

struct Node<'a> {
    bus: &'a Bus,
    air: LinkEmulator,
    options: &'a NodeOptions,
    inbox: Arc<Inbox>,
    roll_call: Membership,
    vehicles: BTreeMap<CavId, Vehicle>,
    /// For whom there was no place.
    turned_away: BTreeSet<CavId>,
    /// Messages that are under way.
    kept: BTreeMap<u64, Arrival>,
    /// Their bytes.
    kept_bytes: u64,
    next_id: u64,
    /// When the first message came: time 0 of the air.
    began: Option<Instant>,
    /// Capture time of the first, from which clocks drift.
    began_nanos: Option<u64>,
    report: LinkReport,
}

impl<'a> Node<'a> {
    fn open(bus: &'a Bus, air: LinkEmulator, options: &'a NodeOptions, stop: &Stop) -> Result<Self, BusError> {
        let inbox = bus.limited_inbox(PLACES, MAX_VEHICLES * (options.streams.len() + 1), options.inbox);
        stop.on_request({
            let inbox = Arc::clone(&inbox);
            move || inbox.close()
        });
        let roll_call = Membership::begin(bus, Role::Agent, 2 * MAX_VEHICLES)?;
        Ok(Self {
            bus,
            air,
            options,
            inbox,
            roll_call,
            vehicles: BTreeMap::new(),
            turned_away: BTreeSet::new(),
            kept: BTreeMap::new(),
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
            self.look_round()?;
            match self.inbox.take(Some(self.next_moment())) {
                Pop::Item(Topic::Stream { cav, stream: Stream::Gnss }, Event::Message(arrival)) => {
                    self.locate(&cav, &arrival);
                }
                Pop::Item(Topic::Stream { cav, stream }, Event::Message(arrival)) => self.admit(cav, stream, arrival),
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
        let mut senders = self.vehicles.iter().filter(|(cav, _)| **cav != self.options.ego).peekable();
        !self.options.keeps_running
            && senders.peek().is_some()
            && senders.all(|(_, vehicle)| self.options.streams.iter().all(|stream| vehicle.ended.contains(stream)))
            && self.kept.is_empty()
    }

    /// Follows up on who came and went.
    fn look_round(&mut self) -> Result<(), BusError> {
        while let Some((cav, is_there)) = self.roll_call.next() {
            match self.vehicles.get_mut(&cav) {
                Some(vehicle) if is_there => {
                    // It was away and sends again.
                    vehicle.ended.clear();
                    vehicle.is_gone = false;
                }
                Some(vehicle) => {
                    // What it sent before may still be under way.
                    vehicle.ended.extend(self.options.streams.iter().copied());
                    vehicle.is_gone = true;
                }
                None if is_there => self.welcome(cav)?,
                None => {}
            }
        }
        Ok(())
    }

    /// Gives a newcomer a place; where all are taken, that of one who has gone.
    fn welcome(&mut self, cav: CavId) -> Result<(), BusError> {
        if self.vehicles.len() >= MAX_VEHICLES {
            let has_kept = |cav: &CavId| self.kept.values().any(|arrival| arrival.header.stamp.cav == *cav);
            let Some(gone) = place_to_free(&self.vehicles, &self.options.ego, has_kept).cloned() else {
                self.turn_away(cav);
                return Ok(());
            };
            self.vehicles.remove(&gone);
        }
        let vehicle = self.attach(&cav)?;
        tracing::info!(%cav, "its messages cross the link");
        self.vehicles.insert(cav, vehicle);
        Ok(())
    }

    fn turn_away(&mut self, cav: CavId) {
        if self.turned_away.len() < MAX_TURNED_AWAY && !self.turned_away.contains(&cav) {
            tracing::warn!(%cav, "its messages do not cross the link, which carries at most {MAX_VEHICLES} vehicles");
            self.turned_away.insert(cav);
        }
    }

    fn attach(&self, cav: &CavId) -> Result<Vehicle, BusError> {
        let subscribe = |stream| self.bus.subscribe(Topic::Stream { cav: cav.clone(), stream }, &self.inbox);
        let mut subscriptions = vec![subscribe(Stream::Gnss)?];
        let mut publishers = BTreeMap::new();
        // An ego hears its own agent without any air between.
        let streams = if *cav == self.options.ego { &[][..] } else { &self.options.streams };
        for &stream in streams {
            subscriptions.push(subscribe(stream)?);
            let topic = Topic::Received { ego: self.options.ego.clone(), cav: cav.clone(), stream };
            let how = if stream == Stream::Pose { PublisherOptions::POSE } else { PublisherOptions::FEATURES };
            // The air has decided what is lost; after it nothing is.
            publishers.insert(stream, self.bus.publisher(topic, how.lossless(PLACES))?);
        }
        let (ended, position_m, is_gone) = (BTreeSet::new(), None, false);
        Ok(Vehicle { publishers, ended, position_m, is_gone, _subscriptions: subscriptions })
    }

    /// Takes note of where a vehicle is: loss may depend on distance.
    fn locate(&mut self, cav: &CavId, arrival: &Arrival) {
        let Some(Gnss { world_from_lidar, .. }) = self.inbox.decode(arrival, &Limits::DEFAULT) else { return };
        self.bus.books().received(&arrival.topic);
        if let Some(vehicle) = self.vehicles.get_mut(cav) {
            vehicle.position_m = Some(world_from_lidar.translation_m);
        }
    }

    fn admit(&mut self, from: CavId, stream: Stream, arrival: Arrival) {
        let began = *self.began.get_or_insert(arrival.at);
        let distance_m = self.distance_m(&from);
        self.report.offered += 1;
        match self.vehicles.get_mut(&from) {
            // The end that was heard was that of an earlier life, which can come after the news of the next one.
            Some(vehicle) => {
                vehicle.ended.remove(&stream);
            }
            // It has gone, and its place is another's.
            None => return self.lose(&arrival, DropReason::PeerOffline),
        }
        if self.kept_bytes.saturating_add(arrival.wire_bytes()) > self.options.max_kept_bytes {
            return self.lose(&arrival, DropReason::LinkQueue);
        }
        self.kept_bytes += arrival.wire_bytes();
        self.air.offer(Packet {
            id: self.next_id,
            from,
            to: self.options.ego.clone(),
            stream,
            sequence: arrival.header.stamp.sequence,
            bytes: arrival.wire_bytes(),
            offered_nanos: nanos::between(began, arrival.at),
            distance_m,
        });
        self.kept.insert(self.next_id, arrival);
        self.next_id += 1;
    }

    /// Between a sender and the ego; 0 while either's place is not known.
    fn distance_m(&self, from: &CavId) -> f64 {
        let position = |cav: &CavId| self.vehicles.get(cav).and_then(|vehicle| vehicle.position_m);
        match (position(from), position(&self.options.ego)) {
            (Some(from), Some(to)) => (from[0] - to[0]).hypot(from[1] - to[1]),
            _ => 0.0,
        }
    }

    /// Passes on what has arrived by now.
    fn settle(&mut self) {
        let Some(began) = self.began else { return };
        for Outcome { parcel, fate, .. } in self.air.advance(nanos::between(began, Instant::now())) {
            match fate {
                Delivery::Dropped(reason) => {
                    if let Some(lost) = self.release(parcel.id) {
                        self.lose(&lost, reason);
                    }
                }
                Delivery::Arrived { is_copy, is_repeated } => self.pass_on(&parcel, is_copy, is_repeated),
            }
        }
    }

    fn pass_on(&mut self, parcel: &Packet, is_copy: bool, is_repeated: bool) {
        let publisher = self.vehicles.get(&parcel.from).and_then(|vehicle| vehicle.publishers.get(&parcel.stream));
        let (Some(publisher), Some(arrival)) = (publisher, self.kept.get(&parcel.id)) else { return };
        match arrival.header.stamp.capture_nanos {
            // What tells of no moment has no capture time.
            0 => publisher.relay(arrival),
            scene_nanos => {
                let began_nanos = *self.began_nanos.get_or_insert(scene_nanos);
                publisher.relay_as(arrival, self.air.clock().shown_since(began_nanos, scene_nanos));
            }
        }
        if is_copy {
            self.report.copies += 1;
        } else {
            self.report.arrived += 1;
            self.bus.books().received(&arrival.topic);
        }
        if !is_repeated {
            self.release(parcel.id);
        }
    }

    /// Counts a message that is not passed on.
    fn lose(&mut self, arrival: &Arrival, reason: DropReason) {
        *self.report.dropped.entry(reason).or_default() += 1;
        self.bus.books().dropped(&arrival.topic, reason);
    }

    /// Keeps a message no longer.
    fn release(&mut self, id: u64) -> Option<Arrival> {
        let released = self.kept.remove(&id)?;
        self.kept_bytes = self.kept_bytes.saturating_sub(released.wire_bytes());
        Some(released)
    }

    fn next_moment(&self) -> Instant {
        let soon = Instant::now() + LOOK_ROUND;
        let next = self.began.zip(self.air.next_nanos()).map(|(began, nanos)| began + Duration::from_nanos(nanos));
        next.map_or(soon, |next| next.min(soon))
    }
}

/// Someone who has vanished and of whom nothing is under way any more; never the ego, whose place in the world counts.
fn place_to_free<'v>(
    vehicles: &'v BTreeMap<CavId, Vehicle>,
    ego: &CavId,
    has_kept: impl Fn(&CavId) -> bool,
) -> Option<&'v CavId> {
    let is_free = |(cav, vehicle): &(&CavId, &Vehicle)| vehicle.is_gone && *cav != ego && !has_kept(cav);
    vehicles.iter().find(is_free).map(|(cav, _)| cav)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_place_of_one_who_has_gone_for_good_is_free() {
        let cav = |id: usize| CavId::new(&id.to_string()).unwrap();
        let vehicle = |is_gone| Vehicle {
            publishers: BTreeMap::new(),
            ended: BTreeSet::new(),
            position_m: None,
            is_gone,
            _subscriptions: Vec::new(),
        };
        let mut vehicles: BTreeMap<CavId, Vehicle> = (0..4).map(|id| (cav(id), vehicle(id < 3))).collect();
        let [ego, on_its_way] = [cav(0), cav(1)];
        let free = |vehicles: &BTreeMap<_, _>| place_to_free(vehicles, &ego, |cav| *cav == on_its_way).cloned();
        assert_eq!(free(&vehicles), Some(cav(2)));
        vehicles.remove(&cav(2));
        assert_eq!(free(&vehicles), None);
    }
}
