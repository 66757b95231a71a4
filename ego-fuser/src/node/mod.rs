//! Node of the ego on the bus: its own agent's message and those of its neighbours in, detections out.
//!
//! A frame begins with the message of the ego's own agent. It is decided when every neighbour's message of the same
//! capture time has arrived, or when the deadline has passed; later messages serve the next frame, if they are still
//! young enough. One thread receives, fuses and publishes; sending has threads of its own.

mod admit;
mod decide;
mod pace_keeper;

use std::collections::{BTreeSet, VecDeque};
use std::sync::Arc;
use std::time::{Duration, Instant};

use bus::bounded_queue::Pop;
use bus::shutdown::Stop;
use bus::{Bus, BusError, Event, Inbox, InboxLimits, Publisher, PublisherOptions, Subscription};
use protocol::{CavId, DropReason, Limits, Role, Stream, Topic};

use crate::capture_clock::CaptureClocks;
use crate::config::{EgoConfig, EgoSettings, PaceMode};
use crate::ego::{Ego, View};
use crate::neighbourhood::{Neighbourhood, sender_of, topic_of};
use crate::pairing::{Pairing, PairingConfig};
use crate::peer_models::PeerModels;
use fusion::method::Exchange;
use pace_keeper::PaceKeeper;

/// Messages of one sender that may wait while a frame is fused. An ego that needs longer than its frames' period
/// answers frames that have waited this long, so it is no more than a short pause needs.
const PLACES: usize = 2;
/// Results that may wait to be sent.
const RESULTS: usize = 4;
/// Largest number of subscribed topics: of 65 vehicles, their stream and their descriptor.
const MAX_TOPICS: usize = 130;
/// Interval of checks for new agents while no message arrives.
const LOOK_ROUND: Duration = Duration::from_millis(20);
/// Time that a node whose own agent has ended waits for the last messages of its neighbours.
const LAST_WORDS: Duration = Duration::from_secs(2);

/// Options of an ego node.
#[derive(Debug, Clone)]
pub struct NodeOptions {
    /// Longest wait of a frame for its neighbours, from the arrival of the own agent's message.
    pub deadline: Duration,
    /// Pairing of messages with a frame.
    pub pairing: PairingConfig,
    /// The neighbours that may take part; `None`: all that are discovered.
    pub neighbours: Option<BTreeSet<CavId>>,
    /// True if neighbours are received behind the link emulation.
    pub over_link: bool,
    /// True to continue when the own agent has ended, for its next instance.
    pub keeps_running: bool,
    /// True to slow the fleet down where this machine cannot keep up; false to ask for every sweep.
    pub sets_pace: bool,
    /// Limits of received messages.
    pub limits: Limits,
    /// Limits of the inbox, for each sender and in total.
    pub inbox: InboxLimits,
}

impl Default for NodeOptions {
    /// The settings' defaults, all neighbours.
    fn default() -> Self {
        Self::from(&EgoSettings::default())
    }
}

impl From<&EgoSettings> for NodeOptions {
    /// All neighbours, received directly, until the own agent ends.
    fn from(settings: &EgoSettings) -> Self {
        Self {
            deadline: Duration::from_millis(settings.deadline_ms),
            pairing: settings.pairing(),
            neighbours: None,
            over_link: false,
            keeps_running: false,
            sets_pace: settings.pace == PaceMode::Auto,
            limits: Limits::DEFAULT,
            inbox: settings.inbox.limits(),
        }
    }
}

impl From<&EgoConfig> for NodeOptions {
    fn from(config: &EgoConfig) -> Self {
        let neighbours: BTreeSet<CavId> = config.neighbours.iter().cloned().collect();
        Self {
            neighbours: Some(neighbours).filter(|named| !named.is_empty()),
            over_link: config.over_link,
            keeps_running: config.keep_running || config.bus.supervised,
            ..Self::from(&config.ego)
        }
    }
}

/// Summary of an ego's run.
#[derive(Debug, Clone, PartialEq, Eq, Default, serde::Serialize)]
pub struct NodeReport {
    /// Frames decided.
    pub frames: u64,
    /// Neighbours' messages that were fused, over all frames.
    pub fused: u64,
    /// Frames that were decided at the deadline.
    pub at_deadline: u64,
    /// Frames that could not be fused.
    pub failed: u64,
    /// Reason of the first of these.
    pub failure: Option<String>,
}

/// Runs `ego` for the vehicle `cav` on the calling thread until its agent ends or `stop` is requested.
///
/// # Errors
/// [`BusError`] of the bus. Errors of single messages are counted and logged.
pub fn run(
    bus: &Bus,
    cav: &CavId,
    ego: Ego,
    options: &NodeOptions,
    stop: &Stop,
) -> Result<NodeReport, BusError> {
    let mut ego = ego;
    if let Err(error) = ego.warm_up(cav) {
        tracing::warn!("the networks are not warmed up: {error}");
    }
    let mut node = Node::open(bus, cav, ego, options, stop)?;
    let presence = bus.announce(Role::Ego)?;
    node.receive(stop)?;
    let Node {
        detections,
        json,
        pace,
        report,
        ..
    } = node;
    pace.finish();
    detections.finish();
    json.finish();
    presence.withdraw()?;
    Ok(report)
}

/// A message as received, decoded.
struct Received {
    view: View,
    payload_bytes: u64,
    wire_bytes: u64,
}

/// A frame that has begun.
struct OwnFrame {
    /// Sequence of the own agent's message.
    agent_frame: u64,
    capture_nanos: u64,
    /// From its publication to its arrival; `None` if its agent has another clock.
    transport: Option<Duration>,
    begun: Instant,
    view: View,
}

struct Node<'a> {
    bus: &'a Bus,
    cav: CavId,
    ego: Ego,
    options: &'a NodeOptions,
    stream: Stream,
    inbox: Arc<Inbox>,
    neighbourhood: Option<Neighbourhood>,
    models: PeerModels,
    pairing: Pairing<Received>,
    clocks: CaptureClocks,
    frames: VecDeque<OwnFrame>,
    pace: PaceKeeper,
    /// Capture time of the ego's newest sweep, nanoseconds.
    own_nanos: Option<u64>,
    ended: BTreeSet<CavId>,
    detections: Publisher,
    json: Publisher,
    report: NodeReport,
    _own: Vec<Subscription>,
}

impl<'a> Node<'a> {
    fn open(
        bus: &'a Bus,
        cav: &CavId,
        ego: Ego,
        options: &'a NodeOptions,
        stop: &Stop,
    ) -> Result<Self, BusError> {
        let stream = stream_of(ego.method().own_content());
        let inbox = bus.limited_inbox(PLACES, MAX_TOPICS, options.inbox);
        stop.on_request({
            let inbox = Arc::clone(&inbox);
            move || inbox.close()
        });
        let topic = |stream| Topic::Stream {
            cav: cav.clone(),
            stream,
        };
        let streams = vec![Stream::Descriptor, stream];
        let own = streams
            .iter()
            .map(|&stream| bus.subscribe(topic(stream), &inbox))
            .collect::<Result<_, _>>()?;
        // An ego-only method needs no messages of others.
        let neighbourhood = (ego.method().exchange() != Exchange::Nothing)
            .then(|| {
                Neighbourhood::watch(
                    bus,
                    cav,
                    streams,
                    options.over_link,
                    options.neighbours.clone(),
                )
            })
            .transpose()?;
        Ok(Self {
            bus,
            cav: cav.clone(),
            options,
            stream,
            neighbourhood,
            models: PeerModels::new(ego.detector()),
            pairing: Pairing::new(options.pairing),
            clocks: CaptureClocks::measured(),
            frames: VecDeque::new(),
            pace: PaceKeeper::open(bus, cav, options.sets_pace)?,
            own_nanos: None,
            ended: BTreeSet::new(),
            detections: bus.publisher(
                topic(Stream::Detections),
                PublisherOptions::DETECTIONS.waiting(RESULTS),
            )?,
            json: bus.publisher(topic(Stream::DetectionsJson), PublisherOptions::DETECTIONS)?,
            report: NodeReport::default(),
            _own: own,
            ego,
            inbox,
        })
    }

    fn receive(&mut self, stop: &Stop) -> Result<(), BusError> {
        let _working = self.bus.works_from(&self.inbox);
        while !stop.requested() {
            self.look_round()?;
            self.pace.repeat();
            match self.inbox.take(Some(self.next_moment())) {
                Pop::Item(_, Event::Message(arrival)) => self.admit(&arrival),
                Pop::Item(topic, Event::End { .. }) if !self.options.keeps_running => {
                    if topic == self.topic(&self.cav) {
                        return self.finish(stop);
                    }
                    self.end(topic);
                }
                Pop::Item(_, Event::End { .. }) | Pop::TimedOut => {}
                Pop::Closed => return Ok(()),
            }
            self.decide(false);
        }
        Ok(())
    }

    /// Ends after the own agent: the frames that wait have their usual time, the neighbours' last messages are counted.
    fn finish(&mut self, stop: &Stop) -> Result<(), BusError> {
        let until = Instant::now() + LAST_WORDS.max(self.options.deadline);
        while !stop.requested()
            && Instant::now() < until
            && !(self.frames.is_empty() && self.all_have_ended())
        {
            self.look_round()?;
            match self.inbox.take(Some(self.next_moment())) {
                Pop::Item(_, Event::Message(arrival)) => self.admit(&arrival),
                Pop::Item(topic, Event::End { .. }) => self.end(topic),
                Pop::TimedOut => {}
                Pop::Closed => break,
            }
            self.decide(false);
        }
        self.decide(true);
        // Messages that wait for a frame that will not come.
        let (_, dropped) = self.pairing.pair(u64::MAX);
        for lost in dropped {
            self.bus
                .stats()
                .dropped(&self.topic(&lost.cav), lost.reason);
        }
        Ok(())
    }

    /// Records the end of a neighbour's stream.
    fn end(&mut self, topic: Topic) {
        if let Some((cav, stream)) = sender_of(&topic)
            && stream == self.stream
        {
            self.ended.insert(cav.clone());
        }
    }

    fn all_have_ended(&self) -> bool {
        self.neighbourhood
            .iter()
            .flat_map(Neighbourhood::members)
            .all(|cav| self.ended.contains(cav))
    }

    fn look_round(&mut self) -> Result<(), BusError> {
        let Some(neighbourhood) = &mut self.neighbourhood else {
            return Ok(());
        };
        for cav in neighbourhood.update(self.bus, &self.inbox)? {
            let topic = self.topic(&cav);
            self.models.forget(&cav);
            self.clocks.forget(&cav);
            self.ended.remove(&cav);
            for _ in 0..self.pairing.forget(&cav) {
                self.bus.stats().dropped(&topic, DropReason::Stale);
            }
        }
        Ok(())
    }

    fn topic(&self, cav: &CavId) -> Topic {
        topic_of(&self.cav, cav, self.stream, self.options.over_link)
    }

    fn next_moment(&self) -> Instant {
        let soon = Instant::now() + LOOK_ROUND;
        self.frames
            .front()
            .map_or(soon, |frame| soon.min(frame.begun + self.options.deadline))
    }
}

fn stream_of(exchange: Exchange) -> Stream {
    match exchange {
        Exchange::Boxes => Stream::Boxes,
        Exchange::Points => Stream::Points,
        Exchange::Features | Exchange::Nothing => Stream::Bev,
    }
}
