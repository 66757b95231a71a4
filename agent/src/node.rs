//! Agent on the bus: subscribes to its vehicle's sensors; publishes pose, BEV feature map, boxes or points.
//!
//! It subscribes to the sensors of its own vehicle only; access control keeps the ground truth from it. One thread
//! receives, computes and submits; encoding and sending have threads of their own.

use std::collections::VecDeque;
use std::path::PathBuf;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};

use bus::bounded_queue::Pop;
use bus::shutdown::Stop;
use bus::{
    Arrival, Bus, BusError, Event, Inbox, MessageStats, NETWORK_TRANSIT_S, Publisher,
    PublisherOptions, Subscription,
};
use perception::detector::Detector;
use protocol::codec::CodecConfig;
use protocol::message::{Bev, Boxes, Descriptor, Points, SweepArrival};
use protocol::{
    CavId, DropReason, Dtype, Gnss, GnssSource, KeyExpr, Lidar, Limits, Pace, PointCloud,
    PoseEstimate, Role, Stream, Topic, wire,
};
use support::sweep_log::SweepLog;

use crate::agent::{Agent, AgentInput, Perception};
use crate::output_filter::{OutputFilter, Unfiltered};
use crate::rate::{RateConfig, RateControl, Turn};
use crate::sweep_pairing::{PairedSweep, SweepPairing, Unused};
use crate::sweep_selection::{MAX_EGOS, SweepSelection};

/// Longest time that a sweep waits for its pose, which was sent before it.
const POSE_TIMEOUT: Duration = Duration::from_millis(200);
/// Poses that may wait in the inbox while a sweep is computed.
const POSE_SLOTS: usize = 32;
/// Period at which an agent publishes its descriptor, for processes that join late and as a report of its sweeps.
const DESCRIPTOR_PERIOD: Duration = Duration::from_millis(500);
/// First sweeps that are reported at once: so many make an estimate of the capture clock.
const EARLY_SWEEPS: usize = 3;
/// Time without a pose after which it is a problem.
const NO_POSE: Duration = Duration::from_secs(3);
/// Sweeps of a report at most.
const MAX_SWEEPS: usize = 32;

/// Options of an agent's node.
#[derive(Debug, Clone)]
pub struct NodeOptions {
    /// Streams beside the pose: any of [`Stream::Bev`], [`Stream::Boxes`] and [`Stream::Points`], for which the agent
    /// needs a detector.
    pub publish: Vec<Stream>,
    /// Codec of feature maps.
    pub codec: CodecConfig,
    /// Rate control of feature maps.
    pub rate: RateConfig,
    /// Egos whose pace is followed; none: any ego's is.
    pub egos: Vec<CavId>,
    /// True to keep running when the replay has ended, for the next one.
    pub keeps_running: bool,
    /// Limits of incoming messages.
    pub limits: Limits,
    /// Log of the arrival of sweeps, if configured.
    pub sweep_log: Option<PathBuf>,
}

impl Default for NodeOptions {
    /// Feature maps as `f32`, dense.
    fn default() -> Self {
        Self {
            publish: vec![Stream::Bev],
            codec: CodecConfig {
                dtype: Dtype::F32,
                ..CodecConfig::default()
            },
            rate: RateConfig::default(),
            egos: Vec::new(),
            keeps_running: false,
            limits: Limits::DEFAULT,
            sweep_log: None,
        }
    }
}

impl NodeOptions {
    /// True if the detector's network is computed: points are published as they are, and poses need none.
    fn needs_network(&self) -> bool {
        self.publish.iter().any(|stream| *stream != Stream::Points)
    }

    /// True if detections are published, or confidence chooses the cells of maps.
    fn needs_head(&self) -> bool {
        let CodecConfig {
            budget_bytes, gate, ..
        } = self.codec;
        self.publish.contains(&Stream::Boxes)
            || budget_bytes.is_some()
            || gate.is_some()
            || self.rate != RateConfig::default()
    }
}

/// Counters of an agent at its end.
#[derive(Debug, Clone, PartialEq, Eq, Default, serde::Serialize)]
pub struct NodeReport {
    /// Sweeps computed.
    pub sweeps: u64,
    /// Of these, without a pose.
    pub no_pose: u64,
    /// Sweeps that could not be computed.
    pub failed: u64,
    /// Reason of the first of these.
    pub failure: Option<String>,
    /// Poses that the vehicle cannot have reached from the previous ones; they are published with little confidence.
    pub pose_jumps: u64,
    /// Paces that are not followed: their egos are not of the run, or there are too many.
    pub unfollowed_paces: u64,
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
) -> Result<NodeReport, BusError> {
    run_filtered(bus, agent, Box::new(Unfiltered), options, stop)
}

/// [`run()`] with a filter on what is published.
///
/// # Errors
/// As [`run()`].
pub fn run_filtered(
    bus: &Bus,
    agent: Agent,
    filter: Box<dyn OutputFilter>,
    options: &NodeOptions,
    stop: &Stop,
) -> Result<NodeReport, BusError> {
    let mut agent = if options.needs_head() || filter.reads_head() {
        agent
    } else {
        agent.without_head()
    };
    if options.needs_network()
        && let Err(error) = agent.warm_up()
    {
        tracing::warn!("the detector is not warmed up: {error}");
    }
    let mut node = Node::open(bus, agent, filter, options, stop)?;
    let presence = bus.announce(Role::Agent)?;
    node.listen(stop);
    let Node {
        publishers, report, ..
    } = node;
    publishers.finish();
    presence.withdraw()?;
    Ok(report)
}

struct Node<'a> {
    bus: &'a Bus,
    agent: Agent,
    filter: Box<dyn OutputFilter>,
    options: &'a NodeOptions,
    inbox: Arc<Inbox>,
    lidar: Topic,
    gnss: Topic,
    imu: Topic,
    pairing: SweepPairing<Arrival>,
    selection: SweepSelection,
    publishers: Publishers,
    report: NodeReport,
    sweep_log: Option<SweepLog>,
    /// Last sweep with a pose, or the first sweep.
    last_pose: Option<Instant>,
    _subscriptions: [Subscription; 4],
}

impl<'a> Node<'a> {
    fn open(
        bus: &'a Bus,
        agent: Agent,
        filter: Box<dyn OutputFilter>,
        options: &'a NodeOptions,
        stop: &Stop,
    ) -> Result<Self, BusError> {
        let topic = |stream| Topic::Stream {
            cav: agent.cav().clone(),
            stream,
        };
        let (lidar, gnss, imu) = (
            topic(Stream::Lidar),
            topic(Stream::Gnss),
            topic(Stream::Imu),
        );
        // One slot: while a sweep is computed only the newest of those that arrive is kept.
        let inbox = bus.inbox(1, 3 + MAX_EGOS);
        stop.on_request({
            let inbox = Arc::clone(&inbox);
            move || inbox.close()
        });
        let publishers = Publishers::open(bus, &agent, options)?;
        let subscriptions = [
            bus.subscribe_keeping(gnss.clone(), POSE_SLOTS, &inbox)?,
            bus.subscribe_keeping(imu.clone(), POSE_SLOTS, &inbox)?,
            bus.subscribe(lidar.clone(), &inbox)?,
            bus.subscribe_all(&KeyExpr::stream(&bus.identity().run, Stream::Pace), &inbox)?,
        ];
        let pairing = SweepPairing::new(POSE_TIMEOUT);
        let sweep_log = options.sweep_log.as_deref().map(SweepLog::open).transpose();
        let sweep_log = sweep_log.unwrap_or_else(|error| {
            tracing::warn!("arrivals of sweeps are not logged: {error}");
            None
        });
        Ok(Self {
            bus,
            agent,
            filter,
            options,
            inbox,
            lidar,
            gnss,
            imu,
            pairing,
            selection: SweepSelection::of(&options.egos),
            publishers,
            report: NodeReport::default(),
            sweep_log,
            last_pose: None,
            _subscriptions: subscriptions,
        })
    }

    fn listen(&mut self, stop: &Stop) {
        let _working = self.bus.works_from(&self.inbox);
        while !stop.requested() {
            self.publishers.describe();
            let deadline = self
                .pairing
                .deadline()
                .unwrap_or(self.publishers.next_descriptor);
            match self
                .inbox
                .take(Some(deadline.min(self.publishers.next_descriptor)))
            {
                Pop::Item(_, Event::Message(arrival)) => self.admit(arrival),
                Pop::Item(topic, Event::End { .. })
                    if topic == self.lidar && !self.options.keeps_running =>
                {
                    // Everything that still waits for a pose has waited for the time-out.
                    self.advance(Instant::now() + POSE_TIMEOUT);
                    return;
                }
                Pop::Item(topic, Event::End { .. }) => self.forget_pace(&topic),
                Pop::TimedOut => {}
                Pop::Closed => return,
            }
            self.advance(Instant::now());
        }
    }

    fn admit(&mut self, arrival: Arrival) {
        let capture_nanos = arrival.header.stamp.capture_nanos;
        if arrival.topic == self.lidar {
            self.publishers
                .note_sweep(capture_nanos, arrival.unix_nanos());
        }
        if let Topic::Stream {
            cav,
            stream: Stream::Pace,
        } = &arrival.topic
        {
            if let Some(pace) = self.inbox.decode::<Pace>(&arrival, &self.options.limits) {
                self.follow_pace(cav, pace);
            }
        } else if arrival.topic == self.lidar
            && !self.selection.admits(capture_nanos, Instant::now())
        {
            self.bus.stats().dropped(&self.lidar, DropReason::Paced);
        } else if arrival.topic == self.lidar {
            let superseded = self
                .pairing
                .add_sweep(capture_nanos, arrival, Instant::now());
            if superseded.is_some() {
                self.bus
                    .stats()
                    .dropped(&self.lidar, DropReason::Superseded);
            }
        } else if arrival.topic == self.imu {
            if let Some(motion) = self.inbox.decode(&arrival, &self.options.limits) {
                let motions = self.pairing.add_motion(capture_nanos, motion);
                self.count_unused(Unused {
                    motions,
                    ..Unused::default()
                });
            }
        } else if let Some(gnss) = self.inbox.decode(&arrival, &self.options.limits) {
            self.admit_pose(capture_nanos, &gnss);
        }
    }

    /// A measured pose waits for its sweep, a stated one restarts the tracker.
    fn admit_pose(&mut self, capture_nanos: u64, gnss: &Gnss) {
        if gnss.source == GnssSource::Stated {
            self.bus.stats().received(&self.gnss);
            let is_taken = self.agent.start_at(capture_nanos, gnss);
            let [x, y, _] = gnss.world_from_lidar.translation_m;
            if is_taken {
                tracing::info!("starts at the stated pose x {x:.2} y {y:.2} m");
            } else {
                tracing::warn!(
                    "the pose source takes no stated pose (tracked does): x {x:.2} y {y:.2} m is ignored"
                );
            }
            return;
        }
        let poses = self.pairing.add_pose(capture_nanos, gnss.world_from_lidar);
        self.count_unused(Unused {
            poses,
            ..Unused::default()
        });
    }

    /// Follows the pace of an ego of the run; others are counted, and the first is logged.
    fn follow_pace(&mut self, ego: &CavId, pace: Pace) {
        if !self.selection.follow(ego, pace, Instant::now()) {
            if self.report.unfollowed_paces == 0 {
                tracing::warn!(%ego, "the pace of this ego is ignored: the run has other egos, or {MAX_EGOS} already");
            }
            self.report.unfollowed_paces += 1;
        }
    }

    /// An ego whose stream of paces has ended has left.
    fn forget_pace(&mut self, topic: &Topic) {
        if let Topic::Stream {
            cav,
            stream: Stream::Pace,
        } = topic
        {
            self.selection.forget(cav);
        }
    }

    /// Counts measurements whose sweeps were superseded, and they with them.
    fn count_unused(&self, unused: Unused) {
        for (topic, count) in [(&self.gnss, unused.poses), (&self.imu, unused.motions)] {
            (0..count).for_each(|_| self.bus.stats().dropped(topic, DropReason::Superseded));
        }
    }

    fn advance(&mut self, now: Instant) {
        while let Some(PairedSweep {
            capture_nanos,
            sweep,
            pose,
            motion,
            unused,
        }) = self.pairing.next(now)
        {
            self.count_unused(unused);
            let used = [(&self.gnss, pose.is_some()), (&self.imu, motion.is_some())];
            used.iter()
                .filter(|(_, is_used)| *is_used)
                .for_each(|(topic, _)| self.bus.stats().received(topic));
            let Some(Lidar { points }) = self.inbox.decode(&sweep, &self.options.limits) else {
                continue;
            };
            let stats = self.bus.stats();
            if let Some(transport) = stats.transport(&sweep, NETWORK_TRANSIT_S) {
                stats.timed("lidar transport", transport);
            }
            let arrived_nanos = sweep.unix_nanos();
            let is_used = self.process(&AgentInput {
                capture_nanos,
                cloud: &points,
                measured_pose: pose.as_ref(),
                motion: motion.unwrap_or_default(),
            });
            match is_used {
                true => self.bus.stats().received(&self.lidar),
                false => self.bus.stats().dropped(&self.lidar, DropReason::NotFinite),
            }
            // Logged after everything is submitted.
            if let Some(Err(error)) = self
                .sweep_log
                .as_mut()
                .map(|log| log.note(capture_nanos, arrived_nanos))
            {
                tracing::warn!("arrivals of sweeps are no longer logged: {error}");
                self.sweep_log = None;
            }
        }
    }

    /// Publishes what is computed from a sweep; false if it could not be computed.
    fn process(&mut self, input: &AgentInput<'_>) -> bool {
        let stats = self.bus.stats();
        let began = Instant::now();
        self.agent.prepare(input.cloud);
        let pose_began = Instant::now();
        let pose = self.filter.pose(self.agent.estimate_pose(input));
        stats.timed("pose", pose_began.elapsed());
        self.publishers.pose.submit(input.capture_nanos, pose);
        self.time_pose_stages();
        self.note_pose(&pose);
        self.report.pose_jumps = self.agent.pose_jumps();
        let perceived = self
            .options
            .needs_network()
            .then(|| self.agent.perceive(input.cloud));
        match perceived.transpose() {
            Ok(perception) => {
                for stage in perception.iter().flat_map(|perception| &perception.times) {
                    stats.timed(&stage.stage, Duration::from_nanos(stage.nanos));
                }
                stats.timed("agent", began.elapsed());
                self.report.sweeps += 1;
                let perception = perception.map(|perception| self.filter.perception(perception));
                let shared = self
                    .publishers
                    .points
                    .is_some()
                    .then(|| self.agent.share_points(input.cloud));
                let shared = shared.map(|points| self.filter.points(points));
                self.publishers
                    .submit(input, pose, perception, shared, stats);
                self.observe(input);
                true
            }
            Err(error) => {
                tracing::error!(
                    capture_nanos = input.capture_nanos,
                    "cannot compute a sweep: {error}"
                );
                self.report.failed += 1;
                let first = &mut self.report.failure;
                first.get_or_insert_with(|| error.to_string());
                false
            }
        }
    }
}

impl Node<'_> {
    /// Measures for the poses of later sweeps, after everything of this one is submitted.
    fn observe(&mut self, input: &AgentInput<'_>) {
        let began = Instant::now();
        if self.agent.observe(input) {
            self.time_pose_stages();
            self.bus.stats().timed("pose measurement", began.elapsed());
        }
    }

    /// Counts a missing pose; no pose for three seconds is a problem.
    fn note_pose(&mut self, pose: &PoseEstimate) {
        let last = *self.last_pose.get_or_insert_with(Instant::now);
        let problem = match pose {
            PoseEstimate::Pose { .. } => {
                self.last_pose = Some(Instant::now());
                None
            }
            PoseEstimate::NoPose { reason, .. } => {
                self.report.no_pose += 1;
                let reason = serde_json::to_string(reason).unwrap_or_default();
                let reason = reason.trim_matches('"').replace('_', " ");
                (last.elapsed() > NO_POSE).then(|| (format!("no pose: {reason}"), last))
            }
        };
        self.bus.stats().set_problems("no pose", problem);
    }

    fn time_pose_stages(&self) {
        for stage in self.agent.pose_stages() {
            self.bus
                .stats()
                .timed(&stage.stage, Duration::from_nanos(stage.nanos));
        }
    }
}

/// Publishers of an agent.
struct Publishers {
    pose: Publisher,
    bev: Option<Publisher>,
    boxes: Option<Publisher>,
    points: Option<Publisher>,
    /// With what it publishes; none without a detector, as no ego can use the vehicle's messages.
    descriptor: Option<(Publisher, Descriptor)>,
    codec: CodecConfig,
    /// Shared with the sending thread, which is where maps are written.
    rate: Arc<Mutex<RateControl>>,
    /// Feature maps submitted so far.
    submitted: u64,
    next_descriptor: Instant,
    /// Capture and arrival times of the sweeps since the last descriptor, nanoseconds.
    sweeps: VecDeque<(u64, u64)>,
    /// Sweeps that are still reported at once.
    early: usize,
}

impl Publishers {
    fn open(bus: &Bus, agent: &Agent, options: &NodeOptions) -> Result<Self, BusError> {
        let publisher = |stream, how| {
            bus.publisher(
                Topic::Stream {
                    cav: agent.cav().clone(),
                    stream,
                },
                how,
            )
        };
        let wanted = |stream| {
            options
                .publish
                .contains(&stream)
                .then(|| publisher(stream, PublisherOptions::FEATURES))
                .transpose()
        };
        let description = |detector: &Detector| Descriptor {
            model_hash: detector.model_hash(),
            grid: detector.grid(),
            channels: u32::try_from(detector.sent_shape()[0]).unwrap_or(u32::MAX),
            dtype: options.codec.dtype,
            streams: std::iter::once(Stream::Pose)
                .chain(options.publish.iter().copied())
                .collect(),
            sweeps: Vec::new(),
        };
        let descriptor = agent.detector().map(|detector| {
            let publisher = publisher(Stream::Descriptor, PublisherOptions::POSE)?;
            Ok::<_, BusError>((publisher, description(detector)))
        });
        Ok(Self {
            pose: publisher(Stream::Pose, PublisherOptions::POSE)?,
            bev: wanted(Stream::Bev)?,
            boxes: wanted(Stream::Boxes)?,
            points: wanted(Stream::Points)?,
            descriptor: descriptor.transpose()?,
            codec: options.codec,
            rate: Arc::new(Mutex::new(RateControl::new(options.rate))),
            submitted: 0,
            next_descriptor: Instant::now(),
            sweeps: VecDeque::new(),
            early: EARLY_SWEEPS,
        })
    }

    fn describe(&mut self) {
        let now = Instant::now();
        if now >= self.next_descriptor {
            self.next_descriptor = now + DESCRIPTOR_PERIOD;
            let newest = self.sweeps.back().map_or(0, |(capture, _)| *capture);
            let arrival = |(capture, arrived_nanos): (u64, u64)| SweepArrival {
                before_nanos: newest.saturating_sub(capture),
                arrived_nanos,
            };
            let sweeps = self.sweeps.drain(..).map(arrival).collect();
            if let Some((publisher, description)) = &self.descriptor {
                let streams = description.streams.clone();
                publisher.submit(
                    newest,
                    Descriptor {
                        sweeps,
                        streams,
                        ..*description
                    },
                );
            }
        }
    }

    /// Adds a sweep to the next descriptor.
    fn note_sweep(&mut self, capture_nanos: u64, arrived_nanos: u64) {
        // The clock of the scene was set back.
        if (self.sweeps.back()).is_some_and(|(newest, _)| capture_nanos < *newest) {
            self.sweeps.clear();
        }
        self.sweeps.push_back((capture_nanos, arrived_nanos));
        if self.sweeps.len() > MAX_SWEEPS {
            self.sweeps.pop_front();
        }
        if self.early > 0 {
            self.early -= 1;
            self.next_descriptor = Instant::now();
            // Before the sweep is computed.
            self.describe();
        }
    }

    fn submit(
        &mut self,
        input: &AgentInput<'_>,
        pose: PoseEstimate,
        perception: Option<Perception>,
        shared: Option<PointCloud>,
        stats: &MessageStats,
    ) {
        if let Some(perception) = perception {
            self.submit_perception(input.capture_nanos, pose, perception, stats);
        }
        if let (Some(publisher), Some(points)) = (&self.points, shared) {
            publisher.submit(input.capture_nanos, Points { pose, points });
        }
    }

    fn submit_perception(
        &mut self,
        capture_nanos: u64,
        pose: PoseEstimate,
        perception: Perception,
        stats: &MessageStats,
    ) {
        let Perception {
            features,
            confidence,
            detections,
            ..
        } = perception;
        if let Some(bev) = &self.bev {
            let (codec, rate, stats, topic) = (
                self.codec,
                Arc::clone(&self.rate),
                stats.clone(),
                bev.topic().clone(),
            );
            let (number, submitted) = (self.submitted, Instant::now());
            self.submitted += 1;
            // The choice of format, selection, quantisation and compression run on the sending thread, at the map's
            // turn.
            bev.submit_encoded(capture_nanos, move |stamp| {
                let turn = Turn {
                    number,
                    submitted,
                    begun: Instant::now(),
                };
                let mut rate = rate.lock().unwrap_or_else(PoisonError::into_inner);
                let features =
                    rate.encode(features, &codec, &confidence, capture_nanos, Some(&turn))?;
                if let Some(choice) = features.rate {
                    stats.adapted(&topic, choice.reason);
                }
                wire::encode(stamp, Bev { pose, features })
            });
        }
        if let Some(boxes) = &self.boxes {
            boxes.submit(capture_nanos, Boxes { pose, detections });
        }
    }

    fn finish(self) {
        let Self {
            pose,
            bev,
            boxes,
            points,
            descriptor,
            ..
        } = self;
        let descriptor = descriptor.map(|(publisher, _)| publisher);
        let streams = [Some(pose), bev, boxes, points, descriptor];
        streams.into_iter().flatten().for_each(Publisher::finish);
    }
}
