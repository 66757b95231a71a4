//! The node: from a run to a ROS 2 network, until the stop is requested.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::{Scope, ScopedJoinHandle};
use std::time::{Duration, Instant};

use bus::bounded_queue::{BoundedQueue, Pop};
use bus::shutdown::Stop;
use bus::{Bus, PassiveSubscriber, RawMessage, Result};
use protocol::{CavId, KeyExpr, Kind, Limits, Message, Role, Stream, Topic, wire};
use ros2::{FrameNames, RosTopic, Translator, VehicleTopic};
use serde::Serialize;

use super::initial_pose::InitialPose;
use super::lidar_input::{LidarInputs, LidarReport};
use super::motion_input::MotionReport;
use super::node_options::NodeOptions;
use super::other_nodes::{publishes_clock, watch_namesakes};
use super::publisher::RosPublisher;
use super::robot_frames::RobotFrames;
use super::scene_clock::SceneClock;
use super::session::RosSession;
use super::sweeps;

/// Messages of one key that may wait.
const PLACES: usize = 64;
/// Vehicles that may join or leave at one moment.
const EVENTS: usize = 256;
/// Period at which vehicles that have joined or left are looked at.
const POLL_PERIOD: Duration = Duration::from_millis(50);

/// Topics of a vehicle while its agent is there, and while its ego-fuser is.
const OF_AGENT: [VehicleTopic; 2] = [VehicleTopic::Pose, VehicleTopic::Odometry];
const OF_EGO: [VehicleTopic; 4] = {
    use VehicleTopic::{Detections, Markers, TrackMarkers, Tracks};
    [Detections, Markers, Tracks, TrackMarkers]
};

/// Summary of a node: messages published and received.
#[derive(Debug, Clone, PartialEq, Eq, Default, Serialize)]
pub struct NodeReport {
    /// Messages published, by topic; without sweeps.
    pub published: BTreeMap<String, u64>,
    /// Messages of the run that were left out as they could not be read, or came faster than they were published.
    pub left_out: u64,
    /// Messages of LiDARs.
    pub lidar: LidarReport,
    /// Messages of motions, by topic.
    pub motion: BTreeMap<String, MotionReport>,
    /// Poses of robots for which the place of their LiDAR in their odometry frame was not known.
    pub unplaced_poses: u64,
}

impl NodeReport {
    /// True if every message of a sensor could be read.
    pub fn is_complete(&self) -> bool {
        self.lidar.is_complete() && self.motion.values().all(|motion| motion.unreadable == 0)
    }
}

/// Connects the run of `bus` with a ROS 2 network until `stop` is requested.
///
/// # Errors
/// [`bus::BusError`] when a session fails. Errors of single messages are counted and logged.
pub fn run(
    bus: &Bus,
    session: &RosSession,
    options: &NodeOptions,
    stop: &Stop,
) -> Result<NodeReport> {
    use Stream::{Detections, Imu, Pose, Tracks};
    let streams = [Imu, Pose, Detections, Tracks];
    let run = &bus.identity().run;
    let mut selectors: Vec<KeyExpr> = streams.map(|stream| KeyExpr::stream(run, stream)).into();
    selectors.push(KeyExpr::stats(run));
    let subscriber = bus.tap(&selectors, PLACES)?;
    stop.on_request(subscriber.closer());
    let members = Arc::new(BoundedQueue::new(EVENTS, 1));
    let watched = [Role::Agent, Role::Ego].map(|role| {
        let members = Arc::clone(&members);
        // A change beyond those that fit is not noticed: the topics appear with their first message.
        bus.watch(role, move |cav, is_there| {
            drop(members.push((), (role, cav, is_there)));
        })
    });
    let _watched = watched.into_iter().collect::<Result<Vec<_>, _>>()?;
    let frames = RobotFrames::of(options.robots(), options.mount);
    let _transforms = frames.listen(session)?;
    let inputs = (!options.lidars.is_empty())
        .then(|| LidarInputs::open(bus, session, (options, &frames), stop))
        .transpose()?;
    let _namesakes = watch_namesakes(session)?;
    let presence = bus.announce(Role::Ros2)?;
    let report = std::thread::scope(|scope| {
        let reading = inputs.map(|inputs| scope.spawn(move || inputs.run()));
        let node = RunFollower::new(scope, (bus, session, options), frames.clone());
        let followed = node.and_then(|mut node| {
            let ended = node.publish_all(&subscriber, &members);
            // Also after an error, as the scope waits for every thread that it has started.
            node.sweeps.into_values().for_each(Forwarding::end);
            node.report.left_out += subscriber.overwritten() + subscriber.undelivered();
            ended.map(|()| node.report)
        });
        // After an error the threads of the LiDARs have to end too.
        stop.request();
        let read = reading.map(|reading| reading.join().unwrap_or_default());
        let (lidar, motion) = read.unwrap_or_default();
        followed.map(|report| NodeReport {
            lidar,
            motion,
            unplaced_poses: frames.unplaced(),
            ..report
        })
    })?;
    presence.withdraw()?;
    Ok(report)
}

/// Sweeps of one vehicle, forwarded on a thread of their own.
struct Forwarding<'scope> {
    ending: Arc<AtomicBool>,
    thread: ScopedJoinHandle<'scope, ()>,
}

/// State of the thread that follows the run.
struct RunFollower<'scope, 'env> {
    scope: &'scope Scope<'scope, 'env>,
    bus: &'env Bus,
    session: &'env RosSession,
    options: &'env NodeOptions,
    translator: Translator,
    frames: RobotFrames,
    names: FrameNames,
    /// The fixed transforms as they were published last.
    fixed: Vec<u8>,
    /// Absent where `/clock` is not published.
    clock: Option<SceneClock>,
    initial_pose: Option<InitialPose>,
    publishers: BTreeMap<RosTopic, RosPublisher>,
    sweeps: BTreeMap<CavId, Forwarding<'scope>>,
    /// Vehicles that have agents.
    agents: BTreeSet<CavId>,
    /// Numbers of published and of rejected messages.
    report: NodeReport,
}

impl<'scope, 'env> RunFollower<'scope, 'env> {
    fn new(
        scope: &'scope Scope<'scope, 'env>,
        (bus, session, options): (&'env Bus, &'env RosSession, &'env NodeOptions),
        frames: RobotFrames,
    ) -> Result<Self> {
        let mount = options.mount.unwrap_or_default();
        let initial_pose = options.initial_pose_of.clone();
        let initial_pose = initial_pose.map(|cav| InitialPose::of(cav, mount));
        let names = FrameNames::within(session.node.namespace.as_ref());
        let translator = Translator::new(&bus.identity().run)
            .with_frames(names.clone(), options.robots().collect());
        let publishes_clock = publishes_clock(session, options.clock)?;
        let mut node = Self {
            scope,
            bus,
            session,
            options,
            translator,
            frames,
            names,
            fixed: Vec::new(),
            clock: publishes_clock.then(SceneClock::default),
            initial_pose,
            publishers: BTreeMap::new(),
            sweeps: BTreeMap::new(),
            agents: BTreeSet::new(),
            report: NodeReport::default(),
        };
        let clock = publishes_clock.then_some(RosTopic::Clock);
        let initial_pose = node.initial_pose.is_some().then_some(RosTopic::InitialPose);
        let topics = [RosTopic::Tf, RosTopic::TfStatic, RosTopic::Diagnostics].into_iter();
        let mut topics = topics.chain(clock).chain(initial_pose);
        topics.try_for_each(|topic| node.declare(topic))?;
        Ok(node)
    }

    /// Publishes what the run publishes until `subscriber` is closed.
    fn publish_all(
        &mut self,
        subscriber: &PassiveSubscriber,
        members: &BoundedQueue<(), (Role, CavId, bool)>,
    ) -> Result<()> {
        loop {
            // All changes first, so that a topic is there before its first message.
            while let Pop::Item((), (role, cav, is_there)) = members.take(Some(Instant::now())) {
                self.note(role, &cav, is_there)?;
            }
            // The transforms that robots have got since, and the fixed ones if they have changed.
            for (nanos, frame) in self.frames.odometry_in_map() {
                self.publish(RosTopic::Tf, ros2::transforms(nanos, &[frame]))?;
            }
            self.publish_static_transforms()?;
            match subscriber.take(Some(Instant::now() + POLL_PERIOD)) {
                Pop::Item(topic, raw) => self.take(&topic, &raw)?,
                Pop::TimedOut => {}
                Pop::Closed => return Ok(()),
            }
        }
    }

    /// A process of a vehicle has joined or left: its topics appear, or disappear.
    fn note(&mut self, role: Role, cav: &CavId, is_there: bool) -> Result<()> {
        match (role, is_there) {
            (Role::Agent, true) => {
                self.agents.insert(cav.clone());
                self.declare_all(cav, &OF_AGENT)?;
                if !self.options.no_points {
                    self.forward_sweeps(cav)?;
                }
            }
            (_, true) => self.declare_all(cav, &OF_EGO)?,
            (Role::Agent, false) => {
                self.agents.remove(cav);
                self.withdraw(cav, &OF_AGENT);
                if let Some(forwarding) = self.sweeps.remove(cav) {
                    forwarding.end();
                }
            }
            (_, false) => self.withdraw(cav, &OF_EGO),
        }
        Ok(())
    }

    fn declare_all(&mut self, cav: &CavId, topics: &[VehicleTopic]) -> Result<()> {
        let mut topics = topics.iter();
        topics.try_for_each(|topic| self.declare(RosTopic::Vehicle(cav.clone(), *topic)))
    }

    fn withdraw(&mut self, cav: &CavId, topics: &[VehicleTopic]) {
        for topic in topics {
            let topic = RosTopic::Vehicle(cav.clone(), *topic);
            self.publishers.remove(&topic);
        }
    }

    /// The bodies of vehicles below their LiDARs, and the LiDARs of robots in the robots' own frames: all of them in one
    /// message, as only the last is kept for late subscribers.
    fn publish_static_transforms(&mut self) -> Result<()> {
        let mount = self.options.mount.unwrap_or_default();
        let mut in_robots = self.frames.lidars_in_robots(&self.names);
        let robots: BTreeSet<CavId> = self.options.robots().collect();
        let agents = self.agents.iter();
        let frames = agents.filter_map(|cav| match robots.contains(cav) {
            true => in_robots.remove(cav),
            false => Some(ros2::body_in_lidar(&self.names, cav, &mount)),
        });
        let frames: Vec<_> = frames.collect();
        // The stamp of a fixed transform has no meaning.
        let cdr = ros2::transforms(0, &frames);
        // Only after a change: late subscribers get the last message anyway.
        if self.fixed == cdr || self.fixed.is_empty() && frames.is_empty() {
            return Ok(());
        }
        self.fixed.clone_from(&cdr);
        self.publish(RosTopic::TfStatic, cdr)
    }

    fn forward_sweeps(&mut self, cav: &CavId) -> Result<()> {
        // The LiDAR comes from the ROS 2 network: its own topic is there.
        if self.sweeps.contains_key(cav)
            || self.options.lidars.iter().any(|source| source.cav == *cav)
        {
            return Ok(());
        }
        let points = RosTopic::Vehicle(cav.clone(), VehicleTopic::Points);
        let mut publisher = self.session.publisher(&points)?;
        let ending = Arc::<AtomicBool>::default();
        let (bus, vehicle, ended) = (self.bus, cav.clone(), Arc::clone(&ending));
        let names = self.names.clone();
        let thread = self.scope.spawn(move || {
            if let Err(error) = sweeps::forward(bus, &vehicle, (&mut publisher, names), &ended) {
                tracing::error!("sweeps of {vehicle} are no longer published: {error}");
            }
        });
        let forwarding = Forwarding { ending, thread };
        self.sweeps.insert(cav.clone(), forwarding);
        Ok(())
    }

    fn take(&mut self, topic: &Topic, raw: &RawMessage) -> Result<()> {
        let (header, message) = match wire::decode_any(raw.pieces(), &Limits::DEFAULT) {
            Ok((header, _)) if header.kind == Kind::Control => return Ok(()),
            Ok(decoded) => decoded,
            Err(error) => {
                self.report.left_out += 1;
                tracing::warn!("{}: left out: {error}", raw.key);
                return Ok(());
            }
        };
        let capture_nanos = header.stamp.capture_nanos;
        if let Topic::Stream { cav, stream } = topic {
            let clock = self.clock.as_mut();
            let time_nanos = clock.and_then(|clock| clock.advance(cav, *stream, capture_nanos));
            // The clock before the message: nothing has a stamp in the future.
            if let Some(nanos) = time_nanos {
                self.publish(RosTopic::Clock, ros2::clock(nanos))?;
            }
            let publisher = self.publishers.get(&RosTopic::InitialPose);
            let initial_pose = self.initial_pose.as_mut().and_then(|initial| {
                initial.of_message(cav, capture_nanos, &message, || {
                    publisher.is_some_and(RosPublisher::is_wanted)
                })
            });
            if let Some(cdr) = initial_pose {
                self.publish(RosTopic::InitialPose, cdr)?;
            }
            if let Message::Pose(estimate) = &message {
                let pose = estimate.world_from_cav().map(protocol::Pose::isometry);
                self.frames.note_pose(cav, capture_nanos, pose);
            }
        }
        for message in self.translator.translate(topic, capture_nanos, &message) {
            self.publish(message.topic, message.cdr)?;
        }
        Ok(())
    }

    fn declare(&mut self, topic: RosTopic) -> Result<()> {
        if !self.publishers.contains_key(&topic) {
            let publisher = self.session.publisher(&topic)?;
            self.publishers.insert(topic, publisher);
        }
        Ok(())
    }

    fn publish(&mut self, topic: RosTopic, cdr: Vec<u8>) -> Result<()> {
        self.declare(topic.clone())?;
        let name = topic.name(self.session.node.namespace.as_ref());
        *self.report.published.entry(name.to_string()).or_default() += 1;
        let publisher = self.publishers.get_mut(&topic);
        publisher.map_or(Ok(()), |publisher| publisher.publish(cdr))
    }
}

impl Forwarding<'_> {
    fn end(self) {
        self.ending.store(true, Ordering::Relaxed);
        if self.thread.join().is_err() {
            tracing::error!("the thread of a vehicle's sweeps panicked");
        }
    }
}
