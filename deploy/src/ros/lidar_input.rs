//! LiDARs of a ROS 2 network as those of the run's agents: each message is published as a replay would, with the motion of
//! its vehicle.

use std::collections::BTreeMap;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Instant;

use bus::bounded_queue::{BoundedQueue, Pop, PushOutcome};
use bus::shutdown::Stop;
use bus::{Bus, BusError, Publisher, PublisherOptions, unix_nanos};
use dataset::{LiveIntensities, Plausibility};
use protocol::{CavId, Lidar, Limits, Stream, Topic};
use ros2::{Qos, RosName, RosSweep, RosType, read_point_cloud};
use serde::Serialize;
use zenoh::bytes::ZBytes;

use super::agent_topic::AgentTopic;
use super::motion_input::{MotionInput, MotionReport};
use super::node_options::NodeOptions;
use super::refusal_log::RefusalLog;
use super::robot_frames::RobotFrames;
use super::session::{RosSession, RosSubscription};
use super::stamp_check::{NoTime, OddStamp, StampCheck};
use super::starting_pose::StartingPose;

/// Messages of LiDARs, counted.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize)]
pub struct LidarReport {
    /// Sweeps passed on to agents.
    pub sweeps: u64,
    /// Messages that could not be read.
    pub unreadable: u64,
    /// Sweeps without a point in range, which are left out.
    pub without_points: u64,
    /// Messages with the capture time of the one before.
    pub repeated: u64,
    /// Messages with a capture time of 0.
    pub without_stamp: u64,
    /// Sweeps passed on with a capture time ahead of this machine's clock.
    pub ahead_of_clock: u64,
    /// Sweeps passed on with a capture time before that of the sweep before.
    pub back_in_time: u64,
    /// Messages that came before the one before them was read.
    pub superseded: u64,
    /// Points without coordinates, in sweeps passed on.
    pub points_without_return: u64,
    /// Points beyond the limit of a coordinate.
    pub points_too_far: u64,
    /// Sweeps passed on without a motion, of vehicles that have a topic of it.
    pub sweeps_without_motion: u64,
}

impl LidarReport {
    /// True if no message is missing.
    pub fn is_complete(&self) -> bool {
        self.unreadable + self.without_stamp + self.without_points == 0
    }
}

/// One LiDAR.
struct LidarInput {
    cav: CavId,
    topic: RosName,
    publisher: Publisher,
    motion: Option<MotionInput>,
    starting_pose: Option<StartingPose>,
    frames: RobotFrames,
    stamps: StampCheck,
    intensities: LiveIntensities,
    log: RefusalLog,
    /// Apart from `log`, whose kinds of reasons come from outside.
    odd_stamps: RefusalLog,
    _subscription: RosSubscription,
}

/// All LiDARs.
pub(super) struct LidarInputs {
    inputs: BTreeMap<CavId, LidarInput>,
    queue: Arc<BoundedQueue<CavId, ZBytes>>,
    superseded: Arc<AtomicU64>,
    report: LidarReport,
}

impl LidarInputs {
    /// Subscribes to the LiDARs of `options`, and to the motions and starting poses of the same vehicles.
    pub(super) fn open(
        bus: &Bus,
        session: &RosSession,
        (options, frames): (&NodeOptions, &RobotFrames),
        stop: &Stop,
    ) -> Result<Self, BusError> {
        // One place: an agent computes the newest sweep.
        let queue = Arc::new(BoundedQueue::new(1, options.lidars.len()));
        let superseded = Arc::<AtomicU64>::default();
        stop.on_request({
            let queue = Arc::clone(&queue);
            move || queue.close()
        });
        let mut inputs = BTreeMap::new();
        for AgentTopic { topic, cav } in &options.lidars {
            // A robot's agent stays when this node ends, and is served by its next instance.
            let lidar = Topic::stream(cav, Stream::Lidar);
            let publisher = bus.publisher(lidar, PublisherOptions::SENSOR.live())?;
            let mut starting_poses = options.starting_poses.iter();
            let starting_pose = starting_poses.find(|source| source.cav == *cav);
            let (queue, superseded) = (Arc::clone(&queue), Arc::clone(&superseded));
            let lane = cav.clone();
            // Runs on zenoh's receive thread, so it only queues. Sweeps are decoded by the queue's reader.
            let ros_type = RosType::PointCloud2;
            let subscription =
                session.subscribe(topic, ros_type, Qos::SENSOR_DATA, move |sample| {
                    let outcome = queue.push(lane.clone(), sample.payload().clone());
                    if let PushOutcome::Replaced(_) | PushOutcome::NoLane(_) = outcome {
                        superseded.fetch_add(1, Ordering::Relaxed);
                    }
                })?;
            let input = LidarInput {
                cav: cav.clone(),
                topic: topic.clone(),
                publisher,
                motion: MotionInput::open(bus, session, (cav, frames), &options.motions)?,
                starting_pose: starting_pose
                    .map(|source| StartingPose::open(bus, session, source))
                    .transpose()?,
                frames: frames.clone(),
                stamps: StampCheck::default(),
                intensities: LiveIntensities::new(options.intensity_scale),
                log: RefusalLog::of(topic.clone(), ros_type),
                odd_stamps: RefusalLog::of(topic.clone(), ros_type),
                _subscription: subscription,
            };
            inputs.insert(cav.clone(), input);
        }
        Ok(Self {
            inputs,
            queue,
            superseded,
            report: LidarReport::default(),
        })
    }

    /// Passes messages on until the stop is requested. Messages of LiDARs, and of motions by topic.
    pub(super) fn run(mut self) -> (LidarReport, BTreeMap<String, MotionReport>) {
        while let Pop::Item(cav, bytes) = self.queue.take(None) {
            if let Some(input) = self.inputs.get_mut(&cav) {
                input.take(&bytes.to_bytes(), &mut self.report);
            }
        }
        let mut motions = BTreeMap::new();
        for input in self.inputs.into_values() {
            input.publisher.finish();
            if let Some(starting_pose) = input.starting_pose {
                starting_pose.publisher.finish();
            }
            motions.extend(input.motion.map(MotionInput::finish).unwrap_or_default());
        }
        self.report.superseded = self.superseded.load(Ordering::Relaxed);
        (self.report, motions)
    }
}

impl LidarInput {
    fn take(&mut self, bytes: &[u8], report: &mut LidarReport) {
        let sweep = match read_point_cloud(bytes, &Limits::DEFAULT) {
            Ok(sweep) => sweep,
            Err(error) => {
                report.unreadable += 1;
                return self.log.warn(&error);
            }
        };
        // Read before the check, which replaces it.
        let previous_nanos = self.stamps.last_nanos;
        match self.stamps.take(sweep.capture_nanos, unix_nanos()) {
            Ok(odd) => {
                odd.into_iter().for_each(|odd| self.note(odd, report));
                self.pass_on(sweep, previous_nanos, report);
            }
            Err(left_out) => {
                match left_out {
                    NoTime::Zero => report.without_stamp += 1,
                    NoTime::Repeated(_) => report.repeated += 1,
                }
                self.log.warn(&left_out);
            }
        }
    }

    /// Counts a stamp that is used although it is odd; names it now and then.
    fn note(&mut self, odd: OddStamp, report: &mut LidarReport) {
        match odd {
            OddStamp::Ahead(_) => report.ahead_of_clock += 1,
            OddStamp::Back(_) => report.back_in_time += 1,
        }
        if self.odd_stamps.is_due(&odd.to_string(), Instant::now()) {
            tracing::warn!("{}: {odd}", self.topic);
        }
    }

    fn pass_on(
        &mut self,
        mut sweep: RosSweep,
        previous_nanos: Option<u64>,
        report: &mut LidarReport,
    ) {
        if let Some(reason) = Plausibility::of(&sweep.points).nothing_in_range() {
            report.without_points += 1;
            self.log.warn(&reason);
            return;
        }
        report.sweeps += 1;
        report.points_without_return += sweep.without_return as u64;
        report.points_too_far += sweep.too_far as u64;
        self.frames.note_lidar(&self.cav, &sweep.frame_id);
        // Before the sweep: the agent waits for nothing then.
        if let Some(starting_pose) = &self.starting_pose {
            starting_pose.publish(sweep.capture_nanos, || {
                self.frames.base_from_lidar(&self.cav, sweep.capture_nanos)
            });
        }
        if let Some(motion) = &mut self.motion
            && !motion.publish(previous_nanos, sweep.capture_nanos)
        {
            report.sweeps_without_motion += 1;
        }
        if let Some(finding) = self.intensities.scale(&mut sweep.points, sweep.intensity) {
            tracing::warn!("{}: {finding}", self.topic);
        }
        let points = sweep.points;
        self.publisher.submit(sweep.capture_nanos, Lidar { points });
    }
}
