//! LiDARs of a ROS 2 network as those of the run's agents: each message is published as a replay would.

use std::collections::BTreeMap;
use std::str::FromStr;
use std::sync::Arc;
use std::time::{Duration, Instant};

use bus::bounded_queue::{BoundedQueue, Pop, PushOutcome};
use bus::shutdown::Stop;
use bus::{Bus, BusError, Publisher, PublisherOptions};
use protocol::{CavId, Lidar, Limits, Stream, Topic};
use ros2::{PointCloudError, Qos, RosName, RosType, Sweep, SweepLimits, read_point_cloud};
use serde::Serialize;
use zenoh::bytes::ZBytes;

use super::session::{RosSession, RosSubscription};

/// Interval between log lines about messages that are left out.
const LOG_PERIOD: Duration = Duration::from_secs(10);
/// Limits of a receiver of the run.
const LIMITS: SweepLimits =
    SweepLimits { max_points: Limits::DEFAULT.max_points, max_abs_value: Limits::DEFAULT.max_abs_value };

/// A topic of `sensor_msgs/PointCloud2` and the vehicle whose LiDAR it is, written `/points=1000`.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct LidarSource {
    /// The topic.
    pub topic: RosName,
    /// The vehicle.
    pub cav: CavId,
}

/// Error of a text that is no [`LidarSource`].
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum LidarSourceError {
    /// There is no `=`.
    #[error("{0:?} is not TOPIC=AGENT, for example /velodyne_points=1000")]
    NoSeparator(String),
    /// The topic is no topic.
    #[error(transparent)]
    Topic(#[from] ros2::NameError),
    /// The vehicle is no vehicle.
    #[error(transparent)]
    Cav(#[from] protocol::IdError),
}

impl FromStr for LidarSource {
    type Err = LidarSourceError;

    fn from_str(text: &str) -> Result<Self, LidarSourceError> {
        let none = || LidarSourceError::NoSeparator(text.chars().take(100).collect());
        let (topic, cav) = text.split_once('=').ok_or_else(none)?;
        Ok(Self { topic: topic.parse()?, cav: cav.parse()? })
    }
}

/// Messages of LiDARs, counted.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize)]
pub struct LidarReport {
    /// Sweeps passed on to agents.
    pub sweeps: u64,
    /// Messages that could not be read.
    pub unreadable: u64,
    /// Messages with the capture time of the one before.
    pub repeated: u64,
    /// Messages that came before the one before them was read.
    pub superseded: u64,
    /// Points without coordinates, in sweeps passed on.
    pub points_without_return: u64,
    /// Points beyond the limit of a coordinate.
    pub points_too_far: u64,
}

impl LidarReport {
    /// True if no message is missing.
    #[must_use]
    pub fn is_complete(&self) -> bool {
        self.unreadable == 0
    }
}

/// One LiDAR.
struct Input {
    topic: RosName,
    publisher: Publisher,
    last_nanos: Option<u64>,
    has_warned_of_intensity: bool,
    logged: Option<Instant>,
    _subscription: RosSubscription,
}

/// All LiDARs.
pub(super) struct LidarInputs {
    inputs: BTreeMap<CavId, Input>,
    queue: Arc<BoundedQueue<CavId, ZBytes>>,
    superseded: Arc<std::sync::atomic::AtomicU64>,
    max_intensity: f32,
    report: LidarReport,
}

impl LidarInputs {
    /// Subscribes to `sources`. Intensities are divided by `max_intensity`.
    pub(super) fn open(
        bus: &Bus,
        session: &RosSession,
        sources: &[LidarSource],
        max_intensity: f32,
        stop: &Stop,
    ) -> Result<Self, BusError> {
        // One place: an agent computes the newest sweep.
        let queue = Arc::new(BoundedQueue::new(1, sources.len()));
        let superseded = Arc::<std::sync::atomic::AtomicU64>::default();
        stop.on_request({
            let queue = Arc::clone(&queue);
            move || queue.close()
        });
        let open = |LidarSource { topic, cav }: &LidarSource| {
            let lidar = Topic::Stream { cav: cav.clone(), stream: Stream::Lidar };
            let publisher = bus.publisher(lidar, PublisherOptions::SENSOR)?;
            let (queue, superseded, lane) = (Arc::clone(&queue), Arc::clone(&superseded), cav.clone());
            let subscription = session.subscribe(topic, RosType::PointCloud2, Qos::SENSOR_DATA, move |sample| {
                match queue.push(lane.clone(), sample.payload().clone()) {
                    PushOutcome::Queued | PushOutcome::Closed(_) => {}
                    PushOutcome::Replaced(_) | PushOutcome::NoLane(_) => {
                        superseded.fetch_add(1, std::sync::atomic::Ordering::Relaxed);
                    }
                }
            })?;
            let input = Input {
                topic: topic.clone(),
                publisher,
                last_nanos: None,
                has_warned_of_intensity: false,
                logged: None,
                _subscription: subscription,
            };
            Ok((cav.clone(), input))
        };
        let inputs = sources.iter().map(open).collect::<Result<_, BusError>>()?;
        Ok(Self { inputs, queue, superseded, max_intensity, report: LidarReport::default() })
    }

    /// Passes messages on until the stop is requested.
    pub(super) fn run(mut self) -> LidarReport {
        while let Pop::Item(cav, bytes) = self.queue.take(None) {
            if let Some(input) = self.inputs.get_mut(&cav) {
                input.take(&bytes.to_bytes(), self.max_intensity, &mut self.report);
            }
        }
        self.inputs.into_values().for_each(|input| input.publisher.finish());
        let superseded = self.superseded.load(std::sync::atomic::Ordering::Relaxed);
        LidarReport { superseded, ..self.report }
    }
}

impl Input {
    fn take(&mut self, bytes: &[u8], max_intensity: f32, report: &mut LidarReport) {
        match read_point_cloud(bytes, LIMITS) {
            Ok(sweep) if self.last_nanos == Some(sweep.capture_nanos) => {
                report.repeated += 1;
                self.log(&format_args!("header.stamp is {} ns as in the message before", sweep.capture_nanos));
            }
            Ok(sweep) => self.pass_on(sweep, max_intensity, report),
            Err(error) => {
                report.unreadable += 1;
                self.refuse(&error);
            }
        }
    }

    fn pass_on(&mut self, mut sweep: Sweep, max_intensity: f32, report: &mut LidarReport) {
        report.sweeps += 1;
        report.points_without_return += sweep.without_return as u64;
        report.points_too_far += sweep.too_far as u64;
        self.last_nanos = Some(sweep.capture_nanos);
        let mut largest = 0.0_f32;
        for [_, _, _, intensity] in &mut sweep.points.xyzi {
            *intensity /= max_intensity;
            largest = largest.max(*intensity);
        }
        if largest > 1.0 && !self.has_warned_of_intensity {
            self.has_warned_of_intensity = true;
            tracing::warn!(
                "{}: intensity up to {largest}; networks are trained on 0 to 1: --intensity-max states the largest value",
                self.topic
            );
        }
        self.publisher.submit(sweep.capture_nanos, Lidar { points: sweep.points });
    }

    fn refuse(&mut self, error: &PointCloudError) {
        self.log(error);
    }

    /// Logs what is left out, at most every ten seconds: a driver that is set up wrongly sends ten such messages a second.
    fn log(&mut self, reason: &dyn std::fmt::Display) {
        if self.logged.is_none_or(|logged| logged.elapsed() > LOG_PERIOD) {
            self.logged = Some(Instant::now());
            tracing::warn!("{}: sensor_msgs/PointCloud2 left out: {reason}", self.topic);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_source_is_a_topic_and_a_vehicle() {
        let source: LidarSource = "/velodyne/points=1000".parse().unwrap();
        assert_eq!((source.topic.as_str(), source.cav.as_str()), ("/velodyne/points", "1000"));
        let error = |text: &str| text.parse::<LidarSource>().unwrap_err().to_string();
        assert!(error("/points").contains("TOPIC=AGENT"));
        assert!(error("points=1000").contains("ROS 2 name") && error("/points=A").contains("CAV id"));
    }
}
