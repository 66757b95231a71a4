//! An ego on the bus: its own agent's message and those of its neighbours in, detections out.
//!
//! A frame begins with the message of the ego's own agent. It is decided when every neighbour's message of the same
//! capture time has come, or when the deadline has passed; whatever comes later serves the next frame, if it is still
//! young enough. One thread receives, fuses and offers; sending has threads of its own.

use std::collections::{BTreeSet, VecDeque};
use std::sync::Arc;
use std::time::{Duration, Instant};

use protocol::message::{Bev, Boxes, DetectionsReport, FusedNeighbour, Points, SkippedNeighbour, StageTiming};
use protocol::{
    Body, CavId, Detections, DropReason, Encoded, HEADER_LEN, Limits, PoseEstimate, Role, Stamp, Stream, Topic, wire,
};
use sim_replay::bus::mailbox::Taken;
use sim_replay::bus::shutdown::Stop;
use sim_replay::bus::{Arrival, Bus, BusError, Event, Inbox, Publisher, PublisherOptions, Subscription, unix_nanos};

use crate::ego::{Content, Ego, EgoOutput, Skipped, View, own_content};
use crate::method::{Exchange, Method};
use crate::neighbourhood::Neighbourhood;
use crate::pairing::{Pairing, PairingConfig};

/// Messages of one sender that may wait while a frame is fused.
const PLACES: usize = 4;
/// Topics an ego listens to at most.
const MAX_TOPICS: usize = 65;
/// How often the node looks for newcomers though no message has come.
const LOOK_ROUND: Duration = Duration::from_millis(20);
/// How long a node whose own agent has ended waits for the last words of its neighbours.
const LAST_WORDS: Duration = Duration::from_secs(2);

/// How an ego takes part.
#[derive(Debug, Clone)]
pub struct NodeOptions {
    /// How long a frame waits for its neighbours, from the arrival of the own agent's message.
    pub deadline: Duration,
    /// Which messages belong together.
    pub pairing: PairingConfig,
    /// The neighbours that may take part; `None`: all that are found.
    pub neighbours: Option<BTreeSet<CavId>>,
    /// Whether to go on when the own agent has ended, for the next one.
    pub keeps_running: bool,
    /// What it takes from the bus.
    pub limits: Limits,
}

impl Default for NodeOptions {
    /// 50 ms of deadline, all neighbours.
    fn default() -> Self {
        Self {
            deadline: Duration::from_millis(50),
            pairing: PairingConfig::default(),
            neighbours: None,
            keeps_running: false,
            limits: Limits::DEFAULT,
        }
    }
}

/// What an ego did.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, serde::Serialize)]
pub struct NodeReport {
    /// Frames decided.
    pub frames: u64,
    /// Neighbours' messages that were fused, over all frames.
    pub fused: u64,
    /// Frames that were decided at the deadline.
    pub at_deadline: u64,
    /// Frames that could not be fused.
    pub failed: u64,
}

/// Runs `ego` for the vehicle `cav` on the calling thread until its agent ends or `stop` is requested.
///
/// # Errors
/// [`BusError`] when the bus refuses. What goes wrong with single messages is counted and logged.
pub fn run(bus: &Bus, cav: &CavId, ego: Ego, options: &NodeOptions, stop: &Stop) -> Result<NodeReport, BusError> {
    let mut node = Node::open(bus, cav, ego, options, stop)?;
    let presence = bus.announce(Role::Ego)?;
    node.listen(stop)?;
    let Node { detections, json, report, .. } = node;
    detections.finish();
    json.finish();
    presence.withdraw()?;
    Ok(report)
}

/// A message as it came, decoded.
struct Received {
    view: View,
    payload_bytes: u64,
    wire_bytes: u64,
}

/// A frame that has begun.
struct OwnFrame {
    capture_nanos: u64,
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
    pairing: Pairing<Received>,
    frames: VecDeque<OwnFrame>,
    ended: BTreeSet<CavId>,
    detections: Publisher,
    json: Publisher,
    report: NodeReport,
    _own: Subscription,
}

impl<'a> Node<'a> {
    fn open(bus: &'a Bus, cav: &CavId, ego: Ego, options: &'a NodeOptions, stop: &Stop) -> Result<Self, BusError> {
        let stream = stream_of(own_content(ego.method()));
        let inbox = bus.inbox(PLACES, MAX_TOPICS);
        stop.on_request({
            let inbox = Arc::clone(&inbox);
            move || inbox.close()
        });
        let topic = |stream| Topic::Stream { cav: cav.clone(), stream };
        // Alone, an ego has nothing to hear from others.
        let neighbourhood = (ego.method() != Method::None)
            .then(|| Neighbourhood::watch(bus, cav, stream, options.neighbours.clone()))
            .transpose()?;
        Ok(Self {
            bus,
            cav: cav.clone(),
            options,
            stream,
            neighbourhood,
            pairing: Pairing::new(options.pairing),
            frames: VecDeque::new(),
            ended: BTreeSet::new(),
            detections: bus.publisher(topic(Stream::Detections), PublisherOptions::DETECTIONS.lossless(PLACES))?,
            json: bus.publisher(topic(Stream::DetectionsJson), PublisherOptions::DETECTIONS)?,
            report: NodeReport::default(),
            _own: bus.subscribe(topic(stream), &inbox)?,
            ego,
            inbox,
        })
    }

    fn listen(&mut self, stop: &Stop) -> Result<(), BusError> {
        while !stop.requested() {
            self.look_round()?;
            match self.inbox.take(Some(self.next_moment())) {
                Taken::Item(_, Event::Message(arrival)) => self.admit(&arrival),
                Taken::Item(Topic::Stream { cav, .. }, Event::End { .. }) if !self.options.keeps_running => {
                    if cav == self.cav {
                        return self.finish(stop);
                    }
                    self.ended.insert(cav);
                }
                Taken::Item(_, Event::End { .. }) | Taken::TimedOut => {}
                Taken::Closed => return Ok(()),
            }
            self.decide(false);
        }
        Ok(())
    }

    /// The own agent has ended: the frames that wait have their usual time, the neighbours' last messages are counted.
    fn finish(&mut self, stop: &Stop) -> Result<(), BusError> {
        let until = Instant::now() + LAST_WORDS.max(self.options.deadline);
        while !stop.requested() && Instant::now() < until && !(self.frames.is_empty() && self.all_have_ended()) {
            self.look_round()?;
            match self.inbox.take(Some(self.next_moment())) {
                Taken::Item(_, Event::Message(arrival)) => self.admit(&arrival),
                Taken::Item(Topic::Stream { cav, .. }, Event::End { .. }) => {
                    self.ended.insert(cav);
                }
                Taken::Item(_, Event::End { .. }) | Taken::TimedOut => {}
                Taken::Closed => break,
            }
            self.decide(false);
        }
        self.decide(true);
        // What waits for a frame that will not come.
        let (_, dropped) = self.pairing.pair(u64::MAX);
        for lost in dropped {
            self.bus.books().dropped(&self.topic(&lost.cav), lost.reason);
        }
        Ok(())
    }

    fn all_have_ended(&self) -> bool {
        self.neighbourhood.iter().flat_map(Neighbourhood::members).all(|cav| self.ended.contains(cav))
    }

    fn look_round(&mut self) -> Result<(), BusError> {
        let Some(neighbourhood) = &mut self.neighbourhood else { return Ok(()) };
        for cav in neighbourhood.update(self.bus, &self.inbox)? {
            let topic = Topic::Stream { cav: cav.clone(), stream: self.stream };
            for _ in 0..self.pairing.forget(&cav) {
                self.bus.books().dropped(&topic, DropReason::Stale);
            }
        }
        Ok(())
    }

    fn next_moment(&self) -> Instant {
        let soon = Instant::now() + LOOK_ROUND;
        self.frames.front().map_or(soon, |frame| soon.min(frame.begun + self.options.deadline))
    }

    fn admit(&mut self, arrival: &Arrival) {
        let Topic::Stream { cav, .. } = &arrival.topic else { return };
        let began = Instant::now();
        let Some((pose, content)) = self.decode(arrival) else { return };
        self.bus.books().timed("decode", began.elapsed());
        let transport = unix_nanos().saturating_sub(arrival.header.stamp.publish_nanos);
        self.bus.books().timed(&format!("{} transport", self.stream), Duration::from_nanos(transport));
        let capture_nanos = arrival.header.stamp.capture_nanos;
        let view = View { cav: cav.clone(), pose, age_nanos: 0, content };
        if *cav == self.cav {
            self.frames.push_back(OwnFrame { capture_nanos, begun: arrival.at, view });
            return;
        }
        if let Some(neighbourhood) = &mut self.neighbourhood {
            neighbourhood.spoke(cav);
        }
        let payload_bytes = u64::from(arrival.header.metadata_len) + arrival.header.body_len;
        let wire_bytes = payload_bytes + HEADER_LEN as u64 + pose_message_bytes(&arrival.header.stamp, pose);
        if let Some(lost) = self.pairing.insert(cav, capture_nanos, Received { view, payload_bytes, wire_bytes }) {
            self.bus.books().dropped(&arrival.topic, lost.reason);
        }
    }

    /// Pose and content of a message; an unsound one is counted under its sender and reason.
    fn decode(&self, arrival: &Arrival) -> Option<(PoseEstimate, Content)> {
        let limits = &self.options.limits;
        match self.stream {
            Stream::Boxes => {
                let Boxes { pose, detections } = self.inbox.decode(arrival, limits)?;
                Some((pose, Content::Boxes(detections)))
            }
            Stream::Points => {
                let Points { pose, points } = self.inbox.decode(arrival, limits)?;
                Some((pose, Content::Points(points)))
            }
            _ => {
                let Bev { pose, features } = self.inbox.decode(arrival, limits)?;
                match features.decode(limits) {
                    Ok(features) => Some((pose, Content::Features(features))),
                    Err(error) => {
                        self.bus.books().rejected(&arrival.topic, &error);
                        None
                    }
                }
            }
        }
    }

    /// Decides the frames that have nothing left to wait for; all of them where `must`.
    fn decide(&mut self, must: bool) {
        while let Some(frame) = self.frames.front() {
            let is_complete = self.is_complete(frame.capture_nanos);
            // A frame with a newer one behind it has waited too long already.
            let is_due = frame.begun.elapsed() >= self.options.deadline || self.frames.len() > 1 || must;
            if !is_complete && !is_due {
                return;
            }
            self.report.at_deadline += u64::from(!is_complete);
            if let Some(frame) = self.frames.pop_front() {
                self.fuse(frame);
            }
        }
    }

    fn is_complete(&self, capture_nanos: u64) -> bool {
        let tolerance = self.options.pairing.max_lead_nanos;
        self.neighbourhood.iter().flat_map(Neighbourhood::awaited).all(|cav| {
            // Or a later one: then this frame's own is lost, and waiting is of no use.
            self.ended.contains(cav)
                || self.pairing.capture_times(cav).any(|time| time.saturating_add(tolerance) >= capture_nanos)
        })
    }

    fn fuse(&mut self, frame: OwnFrame) {
        let OwnFrame { capture_nanos, begun, view: own } = frame;
        let waited = begun.elapsed();
        let Choice { neighbours, sizes, mut skipped } = self.choose(capture_nanos);
        let own_topic = self.topic(&self.cav);
        let output = match self.ego.detect(&own, &neighbours.iter().map(|(view, _)| view.clone()).collect::<Vec<_>>()) {
            Ok(output) => output,
            Err(error) => {
                tracing::error!(capture_nanos, "a frame could not be fused: {error}");
                self.report.failed += 1;
                self.bus.books().dropped(&own_topic, DropReason::Shape);
                for (view, is_first_use) in &neighbours {
                    self.settle(&view.cav, *is_first_use, None);
                }
                return;
            }
        };
        self.bus.books().received(&own_topic);
        let EgoOutput { detections, fused, skipped: left_out, stages } = output;
        for &index in &fused {
            let (view, is_first_use) = &neighbours[index];
            self.settle(&view.cav, *is_first_use, None);
        }
        for &(index, why) in &left_out {
            let (view, is_first_use) = &neighbours[index];
            let reason = match why {
                Skipped::Unusable(reason) => Some(reason),
                // It was looked at, and rightly left out.
                Skipped::NotNeeded | Skipped::OutOfRange => None,
            };
            self.settle(&view.cav, *is_first_use, reason);
            if let Some(reason) = reason {
                skipped.push(SkippedNeighbour { cav: view.cav.clone(), reason: Some(reason) });
            }
        }
        let fused: Vec<FusedNeighbour> = (fused.iter())
            .map(|&index| {
                let (View { cav, pose, age_nanos, .. }, (payload_bytes, wire_bytes)) =
                    (&neighbours[index].0, sizes[index]);
                let (cav, age_nanos, confidence) = (cav.clone(), *age_nanos, pose.confidence());
                FusedNeighbour { cav, age_nanos, confidence, payload_bytes, wire_bytes }
            })
            .collect();
        self.report.fused += fused.len() as u64;
        let stages = std::iter::once(StageTiming::new("wait", waited)).chain(stages).collect();
        self.publish(capture_nanos, own.pose, detections, fused, skipped, stages);
    }

    /// The neighbours' messages for a frame, and who has none.
    fn choose(&mut self, capture_nanos: u64) -> Choice {
        let (paired, dropped) = self.pairing.pair(capture_nanos);
        let mut choice = Choice::default();
        for found in paired {
            let view = View { age_nanos: found.age_nanos, ..found.message.view.clone() };
            choice.neighbours.push((view, found.is_first_use));
            choice.sizes.push((found.message.payload_bytes, found.message.wire_bytes));
        }
        let spoke: BTreeSet<CavId> = choice.neighbours.iter().map(|(view, _)| view.cav.clone()).collect();
        for lost in &dropped {
            self.bus.books().dropped(&self.topic(&lost.cav), lost.reason);
        }
        let Some(neighbourhood) = &mut self.neighbourhood else { return choice };
        let silent: Vec<CavId> = neighbourhood.members().filter(|cav| !spoke.contains(cav)).cloned().collect();
        for cav in silent {
            neighbourhood.was_silent(&cav);
            let reason = dropped.iter().rev().find(|lost| lost.cav == cav).map(|lost| lost.reason);
            choice.skipped.push(SkippedNeighbour { cav, reason });
        }
        choice
    }

    /// Books a message that was looked at, the first time it is.
    fn settle(&self, cav: &CavId, is_first_use: bool, reason: Option<DropReason>) {
        let topic = self.topic(cav);
        match reason {
            _ if !is_first_use => {}
            Some(reason) => self.bus.books().dropped(&topic, reason),
            None => self.bus.books().received(&topic),
        }
    }

    fn publish(
        &mut self,
        capture_nanos: u64,
        pose: PoseEstimate,
        detections: Vec<protocol::Detection>,
        fused: Vec<FusedNeighbour>,
        skipped: Vec<SkippedNeighbour>,
        stages: Vec<StageTiming>,
    ) {
        for stage in &stages {
            self.bus.books().timed(&stage.stage, Duration::from_nanos(stage.nanos));
        }
        let frame_index = self.report.frames;
        self.report.frames += 1;
        let method = self.ego.method().name().to_owned();
        let result =
            Detections { ego: self.cav.clone(), frame_index, method, pose, detections, fused, skipped, stages };
        self.detections.offer(capture_nanos, result.clone());
        self.json.offer_encoded(capture_nanos, move |stamp| {
            let head = DetectionsReport::new(stamp, result).to_json().into_bytes();
            Ok(Encoded { head, body: Body::Empty })
        });
    }

    fn topic(&self, cav: &CavId) -> Topic {
        Topic::Stream { cav: cav.clone(), stream: self.stream }
    }
}

#[derive(Default)]
struct Choice {
    neighbours: Vec<(View, bool)>,
    sizes: Vec<(u64, u64)>,
    skipped: Vec<SkippedNeighbour>,
}

fn stream_of(exchange: Exchange) -> Stream {
    match exchange {
        Exchange::Boxes => Stream::Boxes,
        Exchange::Points => Stream::Points,
        Exchange::Features | Exchange::Nothing => Stream::Bev,
    }
}

/// What the neighbour's `pose` message for the same frame took: it says the same as the pose inside this one.
fn pose_message_bytes(stamp: &Stamp, pose: PoseEstimate) -> u64 {
    wire::encode(stamp, pose).map_or(0, |encoded| encoded.wire_bytes() as u64)
}
