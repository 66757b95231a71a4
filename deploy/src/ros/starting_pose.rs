//! Starting pose: a pose that a person states on the ROS 2 network, `/initialpose` of RViz, as a message to the agent.

use std::sync::{Arc, Mutex};

use bus::{Bus, BusError, Publisher, PublisherOptions};
use nalgebra::Isometry3;
use protocol::{Gnss, GnssSource, Stream, Topic};
use ros2::{Qos, RosType, StatedPose};
use support::sync::lock;

use super::agent_topic::AgentTopic;
use super::refusal_log::RefusalLog;
use super::session::{RosSession, RosSubscription};

/// Stated poses of one vehicle. Each waits for the next sweep, whose capture time it gets.
pub(super) struct StartingPose {
    stated: Arc<Mutex<Option<StatedPose>>>,
    pub(super) publisher: Publisher,
    _subscription: RosSubscription,
}

impl StartingPose {
    /// Subscribes to `source`.
    pub(super) fn open(
        bus: &Bus,
        session: &RosSession,
        AgentTopic { topic, cav }: &AgentTopic,
    ) -> Result<Self, BusError> {
        let stated = Arc::<Mutex<Option<StatedPose>>>::default();
        let ros_type = RosType::PoseWithCovarianceStamped;
        let log = Mutex::new(RefusalLog::of(topic.clone(), ros_type));
        let newest = Arc::clone(&stated);
        let subscription = session.subscribe(topic, ros_type, Qos::DEFAULT, move |sample| {
            let read = StatedPose::read(&sample.payload().to_bytes());
            match read {
                Ok(pose) => *lock(&newest) = Some(pose),
                Err(error) => lock(&log).warn(&error),
            }
        })?;
        // The agent takes a stated pose from its GNSS stream, where the source tells the two apart.
        let gnss = Topic::stream(cav, Stream::Gnss);
        Ok(Self {
            stated,
            publisher: bus.publisher(gnss, PublisherOptions::POSE.live())?,
            _subscription: subscription,
        })
    }

    /// Publishes the newest stated pose, if there is a new one, as that of the LiDAR at the capture time of a sweep.
    pub(super) fn publish(
        &self,
        capture_nanos: u64,
        base_from_lidar: impl FnOnce() -> Isometry3<f64>,
    ) {
        let stated = lock(&self.stated).take();
        if let Some(stated) = stated {
            let world_from_lidar = stated.world_from_base.isometry() * base_from_lidar();
            let pose = Gnss {
                world_from_lidar: world_from_lidar.into(),
                position_std_m: stated.position_std_m,
                heading_std_rad: stated.yaw_std_rad,
                source: GnssSource::Stated,
            };
            self.publisher.submit(capture_nanos, pose);
        }
    }
}
