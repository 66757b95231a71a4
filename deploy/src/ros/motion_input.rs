//! Odometry and gyroscopes of a ROS 2 network as the motion of the run's agents: one message for each sweep of a LiDAR.

use std::collections::BTreeMap;
use std::sync::{Arc, Mutex};

use bus::{Bus, BusError, Publisher, PublisherOptions};
use protocol::{CavId, EgoMotion, Stream, Topic};
use ros2::{MotionType, Qos, RosName};
use serde::Serialize;
use support::sync::lock;

use super::agent_topic::AgentTopic;
use super::refusal_log::RefusalLog;
use super::robot_frames::RobotFrames;
use super::session::{RosSession, RosSubscription};
use super::time_series::TimeSeries;

/// A topic with the motion of a vehicle.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct MotionSource {
    /// Type of its messages.
    pub motion_type: MotionType,
    /// Topic and vehicle.
    pub source: AgentTopic,
}

/// Messages of a topic of motion, counted.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize)]
pub struct MotionReport {
    /// Messages that were read.
    pub read: u64,
    /// Messages that could not be read, or in which nothing is measured.
    pub unreadable: u64,
    /// Measurements that were discarded when a message with the same or an earlier stamp followed.
    pub out_of_order: u64,
}

/// Measurements of one vehicle.
#[derive(Debug, Default)]
struct Measurements {
    speed_mps: TimeSeries<f64>,
    yaw_rate_rad_s: TimeSeries<f64>,
    /// By topic.
    reports: BTreeMap<String, MotionReport>,
}

/// Motion of one vehicle.
pub(super) struct MotionInput {
    measurements: Arc<Mutex<Measurements>>,
    publisher: Publisher,
    _subscriptions: Vec<RosSubscription>,
}

impl MotionInput {
    /// Subscribes to those of `sources` that are of `cav`; `None` if there are none. Odometry names `frames` too.
    pub(super) fn open(
        bus: &Bus,
        session: &RosSession,
        (cav, frames): (&CavId, &RobotFrames),
        sources: &[MotionSource],
    ) -> Result<Option<Self>, BusError> {
        let own = sources.iter().filter(|source| source.source.cav == *cav);
        if own.clone().next().is_none() {
            return Ok(None);
        }
        // A gyroscope measures turns better than wheels.
        let has_imu = own
            .clone()
            .any(|source| source.motion_type == MotionType::Imu);
        let measurements = Arc::<Mutex<Measurements>>::default();
        let subscriptions = own.map(|source| {
            let (motion_type, topic) = (source.motion_type, source.source.topic.clone());
            let (measurements, ros_type) = (Arc::clone(&measurements), motion_type.ros_type());
            let report = MotionReport::default();
            lock(&measurements)
                .reports
                .insert(topic.to_string(), report);
            let takes_yaw_rate = motion_type == MotionType::Imu || !has_imu;
            let log = Mutex::new(RefusalLog::of(topic.clone(), ros_type));
            let (cav, frames) = (cav.clone(), frames.clone());
            session.subscribe(&topic.clone(), ros_type, Qos::SENSOR_DATA, move |sample| {
                let bytes = sample.payload().to_bytes();
                if motion_type == MotionType::Odometry {
                    frames.note_odometry(&cav, &bytes);
                }
                let read = motion_type.read(&bytes);
                if let Err(error) = &read {
                    lock(&log).warn(error);
                }
                lock(&measurements).add(&topic, read.ok(), takes_yaw_rate);
            })
        });
        let subscriptions = subscriptions.collect::<Result<_, _>>()?;
        let imu = Topic::stream(cav, Stream::Imu);
        let publisher = bus.publisher(imu, PublisherOptions::POSE.live())?;
        Ok(Some(Self {
            measurements,
            publisher,
            _subscriptions: subscriptions,
        }))
    }

    /// Publishes the motion at the capture time of a sweep: speed then, mean yaw rate since the sweep before. True if
    /// either is known.
    pub(super) fn publish(&mut self, previous_nanos: Option<u64>, capture_nanos: u64) -> bool {
        let motion = lock(&self.measurements).motion(previous_nanos, capture_nanos);
        let is_known = motion != EgoMotion::default();
        if is_known {
            self.publisher.submit(capture_nanos, motion);
        }
        is_known
    }

    /// Ends the stream; messages by topic.
    pub(super) fn finish(self) -> BTreeMap<String, MotionReport> {
        let reports = std::mem::take(&mut lock(&self.measurements).reports);
        self.publisher.finish();
        reports
    }
}

impl Measurements {
    fn add(&mut self, topic: &RosName, read: Option<(u64, EgoMotion)>, takes_yaw_rate: bool) {
        let report = self.reports.entry(topic.to_string()).or_default();
        let Some((nanos, motion)) = read else {
            report.unreadable += 1;
            return;
        };
        report.read += 1;
        if let Some(speed_mps) = motion.speed_mps {
            report.out_of_order += self.speed_mps.add(nanos, speed_mps);
        }
        if let Some(yaw_rate_rad_s) = motion.yaw_rate_rad_s.filter(|_| takes_yaw_rate) {
            report.out_of_order += self.yaw_rate_rad_s.add(nanos, yaw_rate_rad_s);
        }
    }

    fn motion(&self, previous_nanos: Option<u64>, capture_nanos: u64) -> EgoMotion {
        // The first sweep has no interval before it: its yaw rate is that at its capture.
        let previous_nanos = previous_nanos.unwrap_or(capture_nanos);
        EgoMotion {
            speed_mps: self.speed_mps.at(capture_nanos),
            yaw_rate_rad_s: self.yaw_rate_rad_s.mean(previous_nanos, capture_nanos),
        }
    }
}
