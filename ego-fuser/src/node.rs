//! Node of the ego on the bus: brings what arrives to the [ego's loop](crate::ego_loop), and publishes what it decides.
//!
//! One thread receives, fuses and publishes; sending has threads of its own.

use std::collections::BTreeSet;
use std::sync::Arc;
use std::time::{Duration, Instant};

use bus::bounded_queue::Pop;
use bus::shutdown::Stop;
use bus::{
    Arrival, Bus, BusError, Event, Inbox, InboxLimits, Publisher, PublisherOptions, Subscription,
    longest_transit_s, unix_nanos,
};
use protocol::message::{Descriptor, FrameReport, StageTiming};
use protocol::{
    Body, CavId, Detections, DropReason, Encoded, Limits, Payload, Role, Stamp, Stream, Topic, wire,
};
use serde::Serialize;

use crate::capture_clock::SweepTime;
use crate::config::{EgoConfig, EgoSettings, PaceMode};
use crate::ego::Ego;
use crate::ego_loop::recorded::{EgoRecord, KIND, PublishedResult, WireMessage};
use crate::ego_loop::{
    EgoLoop, Input, LoopOptions, LoopReport, Output, Reception, Refusal, Source,
};
use crate::neighbourhood::{Neighbourhood, sender_of, topic_of};
use agent::input_log::{InputFile, InputLog};
use agent::loop_clock::LoopClock;
use fusion::method::Exchange;

/// Messages of one sender that may wait while a frame is fused. An ego that needs longer than its frames' period
/// answers frames that have waited this long, so it is no more than a short pause needs.
const PLACES: usize = 2;
/// Results that may wait to be sent.
const RESULTS: usize = 4;
/// Largest number of subscribed topics: of 65 vehicles, maps, boxes and descriptor.
const MAX_TOPICS: usize = 195;
/// Interval of checks for new agents while no message arrives.
const LOOK_ROUND: Duration = Duration::from_millis(20);

/// Options of an ego node.
#[derive(Debug, Clone)]
pub struct NodeOptions {
    /// Options of the ego's loop.
    pub of_loop: LoopOptions,
    /// The neighbours that may take part; `None`: all that are discovered.
    pub neighbours: Option<BTreeSet<CavId>>,
    /// True if neighbours are received behind the link emulation.
    pub over_link: bool,
    /// True to continue when the own agent has ended, for its next instance.
    pub keeps_running: bool,
    /// Limits of the inbox, for each sender and in total.
    pub inbox: InboxLimits,
    /// File in which the inputs of the loop are recorded; `None`: they are not.
    pub inputs: Option<InputFile>,
}

impl From<&EgoSettings> for NodeOptions {
    /// All neighbours, received directly, until the own agent ends.
    fn from(settings: &EgoSettings) -> Self {
        Self {
            of_loop: LoopOptions {
                sets_pace: settings.pace == PaceMode::Auto,
                has_exact_arrivals: false,
                ..LoopOptions::stepped(settings)
            },
            neighbours: None,
            over_link: false,
            keeps_running: false,
            inbox: settings.inbox.limits(),
            inputs: None,
        }
    }
}

impl From<&EgoConfig> for NodeOptions {
    fn from(config: &EgoConfig) -> Self {
        let neighbours: BTreeSet<CavId> = config.neighbours.iter().cloned().collect();
        let inputs = config.inputs.clone();
        Self {
            neighbours: Some(neighbours).filter(|named| !named.is_empty()),
            over_link: config.over_link,
            keeps_running: config.keep_running || config.bus.supervised,
            inputs: inputs.map(|path| (path, serde_json::to_string(config).unwrap_or_default())),
            ..Self::from(&config.ego)
        }
    }
}

/// Runs `ego` for the vehicle `cav` on the calling thread until its agent ends or `stop` is requested.
///
/// # Errors
/// [`BusError`] of the bus. Errors of single messages are counted and logged.
pub fn run(
    bus: &Bus,
    cav: &CavId,
    mut ego: Ego,
    options: &NodeOptions,
    stop: &Stop,
) -> Result<LoopReport, BusError> {
    if let Err(error) = ego.warm_up(cav) {
        tracing::warn!("the networks are not warmed up: {error}");
    }
    let mut node = EgoNode::open(bus, cav, ego, options, stop)?;
    let presence = bus.announce(Role::Ego)?;
    node.receive(stop)?;
    node.pace.finish();
    node.detections.finish();
    node.tracks.into_iter().for_each(Results::finish);
    presence.withdraw()?;
    Ok(node.ego_loop.report().clone())
}

/// Publishers of one kind of result: as a message, and as JSON.
struct Results {
    binary: Publisher,
    json: Publisher,
}

impl Results {
    fn open(bus: &Bus, cav: &CavId, [binary, json]: [Stream; 2]) -> Result<Self, BusError> {
        let options = PublisherOptions::DETECTIONS;
        Ok(Self {
            binary: bus.publisher(Topic::stream(cav, binary), options.waiting(RESULTS))?,
            json: bus.publisher(Topic::stream(cav, json), options)?,
        })
    }

    /// Submits a result, which is completed when its message has a stamp.
    fn submit<T: Payload + Serialize + Clone + Send + 'static>(
        &self,
        capture_nanos: u64,
        result: T,
        complete: impl FnOnce(&Stamp, &mut T) + Send + 'static,
    ) {
        let mut binary = result.clone();
        self.binary.submit_encoded(capture_nanos, move |stamp| {
            complete(stamp, &mut binary);
            wire::encode(stamp, binary)
        });
        self.json.submit_encoded(capture_nanos, move |stamp| {
            Ok(Encoded {
                head: FrameReport::new(stamp, None, result).to_json().into_bytes(),
                body: Body::Empty,
            })
        });
    }

    fn finish(self) {
        self.binary.finish();
        self.json.finish();
    }
}

/// Log of the inputs of an ego.
type EgoLog = InputLog<Input<WireMessage>, PublishedResult>;

/// Records that a result was published.
fn note(log: Option<EgoLog>, stream: Stream, stamp: &Stamp, stages: Vec<StageTiming>) {
    if let Some(log) = log {
        log.add(&EgoRecord::Published(PublishedResult {
            stream,
            stamp: stamp.clone(),
            stages,
        }));
    }
}

struct EgoNode<'a> {
    bus: &'a Bus,
    cav: CavId,
    ego: Ego,
    ego_loop: EgoLoop,
    options: &'a NodeOptions,
    inbox: Arc<Inbox>,
    neighbourhood: Option<Neighbourhood>,
    clock: LoopClock,
    pace: Publisher,
    detections: Results,
    tracks: Option<Results>,
    log: Option<EgoLog>,
    _own: Vec<Subscription>,
}

impl<'a> EgoNode<'a> {
    fn open(
        bus: &'a Bus,
        cav: &CavId,
        ego: Ego,
        options: &'a NodeOptions,
        stop: &Stop,
    ) -> Result<Self, BusError> {
        let ego_loop = EgoLoop::new(cav, &ego, options.of_loop);
        let inputs = options.inputs.as_ref();
        let log = inputs.and_then(|file| InputLog::create(file, KIND, Some(ego.detector())));
        let inbox = bus.limited_inbox(PLACES, MAX_TOPICS, options.inbox);
        // Ends the wait for the next message at once.
        let closed = Arc::clone(&inbox);
        stop.on_request(move || closed.close());
        let own = [Stream::Descriptor, ego_loop.stream()]
            .into_iter()
            .map(|stream| bus.subscribe(Topic::stream(cav, stream), &inbox))
            .collect::<Result<_, _>>()?;
        // An ego-only method needs no messages of others.
        let neighbourhood = (ego.method().exchange() != Exchange::Nothing)
            .then(|| {
                let streams = ego_loop.neighbour_streams().chain([Stream::Descriptor]);
                let allowed = options.neighbours.clone();
                Neighbourhood::watch(bus, cav, streams.collect(), options.over_link, allowed)
            })
            .transpose()?;
        Ok(Self {
            bus,
            cav: cav.clone(),
            options,
            neighbourhood,
            clock: LoopClock::start(),
            pace: bus.publisher(Topic::stream(cav, Stream::Pace), PublisherOptions::POSE)?,
            detections: Results::open(bus, cav, [Stream::Detections, Stream::DetectionsJson])?,
            tracks: options
                .of_loop
                .tracks
                .then(|| Results::open(bus, cav, [Stream::Tracks, Stream::TracksJson]))
                .transpose()?,
            log,
            _own: own,
            ego_loop,
            ego,
            inbox,
        })
    }

    fn receive(&mut self, stop: &Stop) -> Result<(), BusError> {
        let _working = self.bus.works_from(&self.inbox);
        while !stop.requested() && !self.ego_loop.is_finished() {
            if let Some(neighbourhood) = &mut self.neighbourhood {
                for change in neighbourhood.update(self.bus, &self.inbox)? {
                    self.handle(change);
                }
            }
            let taken = self.inbox.take(Some(self.next_moment()));
            let arrived_nanos = match &taken {
                Pop::Item(_, Event::Message(arrival)) => Some(self.clock.nanos(arrival.at)),
                _ => None,
            };
            match taken {
                Pop::Item(_, Event::Message(arrival)) if self.is_of_departed(&arrival) => {}
                Pop::Item(_, Event::Message(arrival)) => self.admit(&arrival),
                Pop::Item(topic, Event::End { .. }) => self.end(&topic),
                Pop::TimedOut => {}
                Pop::Closed => return Ok(()),
            }
            if is_time(arrived_nanos, self.ego_loop.wakes_nanos()) {
                self.handle(Input::Wake);
            }
            // What the ego waits for is reported with the counters of the process.
            let problems = self.ego_loop.waits.problems(self.clock.now_nanos());
            let problems = problems.into_iter();
            let problems = problems.map(|(problem, since)| (problem, self.clock.moment(since)));
            self.bus.stats().set_problems("ego", problems);
        }
        Ok(())
    }

    /// Decodes a message and hands it to the loop.
    fn admit(&mut self, arrival: &Arrival) {
        let Some((cav, stream)) = sender_of(&arrival.topic) else {
            return;
        };
        if stream == Stream::Descriptor {
            return self.admit_descriptor(cav, arrival);
        }
        let (stats, began) = (self.bus.stats(), Instant::now());
        // The own agent's message takes no link, and has one clock with the ego.
        let longest_s = longest_transit_s(self.options.over_link);
        let transport = stats.transport(arrival, longest_s);
        let reception = Reception {
            cav: cav.clone(),
            arrived_nanos: self.clock.nanos(arrival.at),
            transport,
            clock_offset_s: stats.measured_clock_offset_s(cav),
        };
        let (header, limits) = (&arrival.header, &Limits::DEFAULT);
        let ego_loop = &self.ego_loop;
        let decoded = ego_loop.decode(&reception, header, arrival.pieces(), limits);
        let message = match decoded {
            Ok(message) => message,
            Err(Refusal::Unneeded(reason)) => {
                let now_nanos = self.clock.now_nanos();
                return self.account(&(cav.clone(), stream), Some(reason), now_nanos);
            }
            Err(Refusal::Malformed(error)) => return stats.rejected(&arrival.topic, &error),
        };
        stats.timed("decode", began.elapsed());
        if let Some(transport) = transport {
            stats.timed(&format!("{stream} transport"), transport);
        }
        // Read after the decoding, and recorded: the replay gets the time that the loop gets.
        let now_nanos = self.clock.now_nanos();
        if let Some(log) = &self.log {
            let bytes = arrival.pieces().flatten().copied().collect();
            let input = Input::Message(WireMessage { reception, bytes });
            log.add(&EgoRecord::Input { now_nanos, input });
        }
        self.decide(Input::Message(Box::new(message)), now_nanos);
    }

    /// True for a message that the link delivers after its sender has left, which is counted here: the loop has forgotten
    /// the vehicle, and with it whether its maps are of another network.
    fn is_of_departed(&self, arrival: &Arrival) -> bool {
        let sender = self.neighbourhood.as_ref().zip(sender_of(&arrival.topic));
        let is_departed = sender.is_some_and(|(known, (cav, _))| known.has_left(cav));
        if is_departed && arrival.topic.is_counted() {
            self.bus.stats().dropped(&arrival.topic, DropReason::Stale);
        }
        is_departed
    }

    /// Processes an agent's descriptor: its network, and the arrivals of its sweeps.
    fn admit_descriptor(&mut self, cav: &CavId, arrival: &Arrival) {
        let descriptor = self.inbox.decode::<Descriptor>(arrival, &Limits::DEFAULT);
        let Some(descriptor) = descriptor else {
            return;
        };
        let stats = self.bus.stats();
        let offset_s = stats.system_clock_offset_s(cav, longest_transit_s(self.options.over_link));
        let offset_nanos = (offset_s * 1e9) as i64;
        let newest_nanos = arrival.header.stamp.capture_nanos;
        // Arrivals are on the clock of the agent. Minus its lead they are on that of the ego.
        let sweeps = descriptor.sweeps.iter().map(|sweep| SweepTime {
            capture_nanos: newest_nanos.saturating_sub(sweep.before_nanos),
            arrived_nanos: sweep.arrived_nanos.saturating_sub_signed(offset_nanos),
        });
        self.handle(Input::Sweeps(cav.clone(), sweeps.collect()));
        self.handle(Input::Model(cav.clone(), descriptor));
    }

    fn end(&mut self, topic: &Topic) {
        // The own agent may come again.
        if let Some((cav, stream)) = sender_of(topic)
            && stream != Stream::Descriptor
            && !(self.options.keeps_running && *cav == self.cav)
        {
            self.handle(Input::Ended(cav.clone()));
        }
    }

    /// Records an input without a message, hands it to the loop and carries out what that decides.
    fn handle(&mut self, input: Input) {
        let now_nanos = self.clock.now_nanos();
        // Before the decision and with the time of it, so that a replay decides the same. A message is recorded as it is on
        // the wire, where it is decoded.
        if let Some(log) = &self.log
            && let Ok(input) = input.clone().try_map(|_| Err(()))
        {
            log.add(&EgoRecord::Input { now_nanos, input });
        }
        self.decide(input, now_nanos);
    }

    /// Hands an input to the loop and carries out what it decides.
    fn decide(&mut self, input: Input, now_nanos: u64) {
        for output in self.ego_loop.handle(&mut self.ego, input, now_nanos) {
            match output {
                Output::Publish {
                    capture_nanos,
                    result,
                    tracks,
                } => {
                    self.publish(capture_nanos, *result);
                    if let (Some(results), Some(tracks)) = (&self.tracks, tracks) {
                        let log = self.log.clone();
                        results.submit(capture_nanos, tracks, move |stamp, _| {
                            note(log, Stream::Tracks, stamp, Vec::new());
                        });
                    }
                }
                Output::Failed {
                    capture_nanos,
                    error,
                } => tracing::error!(capture_nanos, "a frame could not be fused: {error}"),
                Output::Counted(source, reason) => self.account(&source, reason, now_nanos),
                Output::Pace(pace) => self.pace.submit(0, pace),
            }
        }
    }

    fn publish(&mut self, capture_nanos: u64, result: Detections) {
        let stats = self.bus.stats();
        // The own message's transport is counted already.
        let stages = result.stages.iter();
        for stage in stages.filter(|stage| stage.stage != "transport") {
            stats.timed(&stage.stage, Duration::from_nanos(stage.nanos));
        }
        for neighbour in &result.neighbours {
            if let Some(trust) = neighbour.trust {
                stats.trusted(&neighbour.cav, trust);
            }
        }
        // The ego does not know when the sensors of its vehicle measured.
        stats.answered(None, result.fused.len());
        // On the Unix clock, as is the time of publication in the stamp.
        let (fused, log) = (unix_nanos(), self.log.clone());
        self.detections
            .submit(capture_nanos, result, move |stamp, result| {
                let sending = Duration::from_nanos(stamp.publish_nanos.saturating_sub(fused));
                result.stages.push(StageTiming::new("send", sending));
                note(log, Stream::Detections, stamp, result.stages.clone());
            });
    }

    /// Counts that a message was used, or why not.
    fn account(&mut self, (cav, stream): &Source, reason: Option<DropReason>, now_nanos: u64) {
        self.ego_loop.waits.note(cav, reason, now_nanos);
        let topic = topic_of(&self.cav, cav, *stream, self.options.over_link);
        match reason {
            Some(reason) => self.bus.stats().dropped(&topic, reason),
            None => self.bus.stats().received(&topic),
        }
    }

    fn next_moment(&self) -> Instant {
        let look_round = Instant::now() + LOOK_ROUND;
        let wakes = self.ego_loop.wakes_nanos();
        wakes.map_or(look_round, |wakes| self.clock.moment(wakes).min(look_round))
    }
}

/// True if the loop is woken: not after a message that arrived before its deadline, as more may have, and all of these are
/// taken before the frame is decided. A later one ends that, so that no stream of messages delays the frame for ever.
fn is_time(arrived_nanos: Option<u64>, wakes_nanos: Option<u64>) -> bool {
    arrived_nanos.is_none_or(|arrived| wakes_nanos.is_none_or(|wakes| arrived >= wakes))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn at_its_deadline_a_frame_is_decided_when_all_messages_are_taken() {
        let deadline = Some(7);
        assert!(!is_time(Some(6), deadline), "more may have arrived");
        assert!(is_time(None, deadline) && is_time(Some(7), deadline));
        assert!(is_time(Some(6), Some(0)), "the frame waits for nothing");
        assert!(is_time(Some(6), None), "the pace is repeated");
    }
}
