//! Node of the agent on the bus: brings what arrives to the [agent's loop](crate::agent_loop), and publishes what it
//! decides: pose, BEV feature map, boxes or points.
//!
//! It subscribes to the sensors of its own vehicle only; access control keeps the ground truth from it. One thread
//! receives, computes and submits; encoding and sending have threads of their own.

use std::path::PathBuf;
use std::sync::Arc;
use std::time::Duration;

use bus::bounded_queue::Pop;
use bus::shutdown::Stop;
use bus::{
    Arrival, Bus, BusError, Event, Inbox, NETWORK_TRANSIT_S, Publisher, PublisherOptions,
    Subscription,
};
use protocol::{KeyExpr, Lidar, Limits, Role, Stream, Topic};
use support::sweep_log::SweepLog;

use crate::agent::Agent;
use crate::agent_loop::recorded::{AgentRecord, KIND, Published};
use crate::agent_loop::{
    AgentLoop, LoopInput, LoopOptions, LoopOutput, LoopReport, MessageEncoder, Sweep, Unsent,
};
use crate::input_log::{InputFile, InputLog};
use crate::loop_clock::LoopClock;
use crate::rate::Turn;
use crate::sweep_selection::MAX_EGOS;

/// Poses that may wait in the inbox while a sweep is computed.
const POSE_SLOTS: usize = 32;
/// Streams that an agent may publish, in the order in which they end.
const STREAMS: [(Stream, PublisherOptions); 5] = [
    (Stream::Pose, PublisherOptions::POSE),
    (Stream::Bev, PublisherOptions::FEATURES),
    (Stream::Boxes, PublisherOptions::FEATURES),
    (Stream::Points, PublisherOptions::FEATURES),
    (Stream::Descriptor, PublisherOptions::POSE),
];

/// Options of an agent's node.
#[derive(Debug, Clone, Default)]
pub struct NodeOptions {
    /// Options of the agent's loop.
    pub of_loop: LoopOptions,
    /// True to keep running when the replay has ended, for the next one.
    pub keeps_running: bool,
    /// Log of the arrival of sweeps, if configured.
    pub sweep_log: Option<PathBuf>,
    /// File in which the inputs of the loop are recorded; `None`: they are not.
    pub inputs: Option<InputFile>,
}

/// Runs `agent` on the calling thread until the replay ends or `stop` is requested.
///
/// # Errors
/// [`BusError`] if the bus fails. Errors of single messages are counted and logged.
pub fn run(
    bus: &Bus,
    agent: Agent,
    options: &NodeOptions,
    stop: &Stop,
) -> Result<LoopReport, BusError> {
    let mut agent_loop = AgentLoop::new(agent, options.of_loop.clone());
    agent_loop.warm_up();
    let mut node = AgentNode::open(bus, agent_loop, options, stop)?;
    // Not announced before all subscriptions exist.
    let presence = bus.announce(Role::Agent)?;
    node.listen(stop);
    // What is queued is sent before the presence ends.
    for (_, publisher) in node.publishers {
        publisher.finish();
    }
    presence.withdraw()?;
    Ok(node.agent_loop.report().clone())
}

struct AgentNode<'a> {
    bus: &'a Bus,
    agent_loop: AgentLoop,
    options: &'a NodeOptions,
    inbox: Arc<Inbox>,
    clock: LoopClock,
    publishers: Vec<(Stream, Publisher)>,
    encoder: Arc<MessageEncoder>,
    log: Option<InputLog<LoopInput, Published>>,
    sweep_log: Option<SweepLog>,
    _subscriptions: [Subscription; 4],
}

impl<'a> AgentNode<'a> {
    fn open(
        bus: &'a Bus,
        agent_loop: AgentLoop,
        options: &'a NodeOptions,
        stop: &Stop,
    ) -> Result<Self, BusError> {
        let agent = agent_loop.agent();
        // One slot: while a sweep is computed only the newest of those that arrive is kept.
        // Topics: three sensors, and the pace of each ego.
        let inbox = bus.inbox(1, 3 + MAX_EGOS);
        // The loop waits at the inbox: a request to stop has to wake it.
        stop.on_request({
            let inbox = Arc::clone(&inbox);
            move || inbox.close()
        });
        let published = STREAMS.into_iter().filter(|(stream, _)| match stream {
            Stream::Pose => true,
            // No ego can use the messages of a vehicle without a detector.
            Stream::Descriptor => agent.detector().is_some(),
            other => options.of_loop.publish.contains(other),
        });
        let publishers = published
            .map(|(stream, how)| Ok((stream, bus.publisher(topic(agent, stream), how)?)))
            .collect::<Result<_, BusError>>()?;
        let subscriptions = [
            bus.subscribe_keeping(topic(agent, Stream::Gnss), POSE_SLOTS, &inbox)?,
            bus.subscribe_keeping(topic(agent, Stream::Imu), POSE_SLOTS, &inbox)?,
            bus.subscribe(topic(agent, Stream::Lidar), &inbox)?,
            bus.subscribe_all(&KeyExpr::stream(&bus.identity().run, Stream::Pace), &inbox)?,
        ];
        let sweep_log = options.sweep_log.as_deref().map(SweepLog::open).transpose();
        let sweep_log = sweep_log.unwrap_or_else(|error| {
            tracing::warn!("arrivals of sweeps are not logged: {error}");
            None
        });
        let log = (options.inputs.as_ref())
            .and_then(|file| InputLog::create(file, KIND, agent.detector()));
        Ok(Self {
            bus,
            options,
            inbox,
            clock: LoopClock::start(),
            publishers,
            encoder: Arc::new(MessageEncoder::new(&options.of_loop)),
            log,
            sweep_log,
            _subscriptions: subscriptions,
            agent_loop,
        })
    }

    fn listen(&mut self, stop: &Stop) {
        let _working = self.bus.works_from(&self.inbox);
        while !stop.requested() && !self.agent_loop.is_finished() {
            let wakes = self.clock.moment(self.agent_loop.wakes_nanos());
            match self.inbox.take(Some(wakes)) {
                Pop::Item(_, Event::Message(arrival)) => self.admit(&arrival),
                Pop::Item(topic, Event::End { .. }) => self.end(&topic),
                Pop::TimedOut => {}
                Pop::Closed => return,
            }
            self.handle(LoopInput::Wake);
            // To its last step, before the next message: sweeps are superseded in the inbox.
            while self.agent_loop.is_computing() {
                self.handle(LoopInput::Wake);
            }
        }
    }

    fn end(&mut self, topic: &Topic) {
        let Topic::Stream { cav, stream } = topic else {
            return;
        };
        match stream {
            Stream::Lidar if self.options.keeps_running => self.handle(LoopInput::SceneEnded),
            Stream::Lidar => self.handle(LoopInput::Ended),
            Stream::Pace => self.handle(LoopInput::PaceEnded(cav.clone())),
            _ => {}
        }
    }

    /// Decodes a message and hands it to the loop.
    fn admit(&mut self, arrival: &Arrival) {
        let Topic::Stream { cav, stream } = &arrival.topic else {
            return;
        };
        let (inbox, limits) = (&self.inbox, &Limits::DEFAULT);
        let capture_nanos = arrival.header.stamp.capture_nanos;
        let input = match stream {
            Stream::Lidar => {
                // Before the sweep is decoded.
                let arrived_nanos = arrival.unix_nanos();
                inbox.decode(arrival, limits).map(|Lidar { points }| {
                    LoopInput::Sweep(Sweep {
                        capture_nanos,
                        arrived_nanos,
                        cloud: points,
                    })
                })
            }
            Stream::Gnss => inbox
                .decode(arrival, limits)
                .map(|gnss| LoopInput::Gnss(capture_nanos, gnss)),
            Stream::Imu => (inbox.decode(arrival, limits))
                .map(|motion| LoopInput::Motion(capture_nanos, motion)),
            // Only paces are left of what the node subscribes to.
            _ => inbox
                .decode(arrival, limits)
                .map(|pace| LoopInput::Pace(cav.clone(), pace)),
        };
        let stats = self.bus.stats();
        if *stream == Stream::Lidar
            && let Some(transport) = stats.transport(arrival, NETWORK_TRANSIT_S)
        {
            stats.timed("lidar transport", transport);
        }
        if let Some(input) = input {
            self.handle(input);
        }
    }

    /// Records an input, hands it to the loop and carries out what that decides.
    fn handle(&mut self, input: LoopInput) {
        let now_nanos = self.clock.now_nanos();
        // Recorded before it is handled: a replay takes it in before it publishes what follows from it.
        if let Some(log) = &self.log {
            let input = input.clone();
            log.add(&AgentRecord::Input { now_nanos, input });
        }
        for output in self.agent_loop.handle(input, now_nanos) {
            let (stats, agent) = (self.bus.stats(), self.agent_loop.agent());
            match output {
                LoopOutput::Publish(message) => self.publish(message),
                LoopOutput::Received(stream) => stats.received(&topic(agent, stream)),
                LoopOutput::Dropped(stream, reason) => stats.dropped(&topic(agent, stream), reason),
                LoopOutput::Timed(stages) => {
                    for stage in stages {
                        stats.timed(&stage.stage, Duration::from_nanos(stage.nanos));
                    }
                }
                LoopOutput::Failed(error) => tracing::error!("cannot compute a sweep: {error}"),
                LoopOutput::Computed {
                    capture_nanos,
                    arrived_nanos,
                } => self.log_sweep(capture_nanos, arrived_nanos),
                LoopOutput::PoseProblem(problem) => {
                    let problem = problem.map(|(text, since)| (text, self.clock.moment(since)));
                    stats.set_problems("no pose", problem);
                }
            }
        }
    }

    fn log_sweep(&mut self, capture_nanos: u64, arrived_nanos: u64) {
        let log = self.sweep_log.as_mut();
        if let Some(Err(error)) = log.map(|log| log.note(capture_nanos, arrived_nanos)) {
            tracing::warn!("arrivals of sweeps are no longer logged: {error}");
            self.sweep_log = None;
        }
    }

    /// Submits a message. Choice of format, selection, quantisation and compression of a feature map run on the sending
    /// thread, at the map's turn.
    fn publish(&self, message: Box<Unsent>) {
        let stream = message.stream;
        let Some((_, publisher)) = self.publishers.iter().find(|(of, _)| *of == stream) else {
            return;
        };
        let (clock, encoder, log) = (self.clock, Arc::clone(&self.encoder), self.log.clone());
        let (stats, topic) = (self.bus.stats().clone(), publisher.topic().clone());
        // Taken here and not on the sending thread: the wait in the queue counts.
        let submitted_nanos = clock.now_nanos();
        publisher.submit_encoded(message.capture_nanos, move |stamp| {
            let turn = Turn {
                number: message.number,
                submitted_nanos,
                begun_nanos: clock.now_nanos(),
            };
            let encoded = encoder.encode(message, stamp, Some(&turn));
            // Recorded even if it could not be encoded: the replay must fail in the same way.
            if let Some(log) = log {
                let bytes = encoded.as_ref().ok().map(|(encoded, _)| encoded);
                let published = Published::new(stream, turn, stamp, bytes);
                log.add(&AgentRecord::Published(published));
            }
            let (encoded, choice) = encoded?;
            if let Some(choice) = choice {
                stats.adapted(&topic, choice.reason);
            }
            Ok(encoded)
        });
    }
}

fn topic(agent: &Agent, stream: Stream) -> Topic {
    Topic::stream(agent.cav(), stream)
}
