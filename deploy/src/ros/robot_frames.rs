//! Frames of robots: the odometry frame of each in the map, as REP-105 has it, from the poses of its LiDAR.
//!
//! A robot publishes where its body is in its odometry frame (tf, or its odometry), continuous and drifting. We publish
//! where that frame is in the map, and nothing of the robot's own.

use std::collections::{BTreeMap, VecDeque};
use std::sync::{Arc, Mutex};

use bus::BusError;
use nalgebra::Isometry3;
use protocol::CavId;
use ros2::names::MAP_FRAME;
use ros2::{FrameInParent, FrameNames, Mount, PoseType, Qos, RosTopic, RosType, Transform};

use support::sync::lock;

use super::session::{RosSession, RosSubscription};
use super::transform_tree::{NoTransform, Origin, TransformTree};

/// Poses of a robot that wait for the transforms of their time: some seconds.
const MOST_WAITING: usize = 32;
/// Time after its sweep until which a transform is stated to hold, nanoseconds: 0.2 s. Other nodes ask for transforms of
/// now, and would have none until the next.
const VALID_NANOS: u64 = 200_000_000;

/// Robots with an odometry, and the transforms of the network.
#[derive(Debug, Clone)]
pub(super) struct RobotFrames {
    state: Arc<Mutex<FramesState>>,
    mount: Option<Mount>,
}

#[derive(Debug, Default)]
struct FramesState {
    tree: TransformTree,
    robots: BTreeMap<CavId, Robot>,
    /// Poses for which there were no transforms.
    unplaced: u64,
}

/// Transforms and latest estimate of one robot.
#[derive(Debug, Default)]
struct Robot {
    /// Odometry frame and frame of the body, as the odometry's messages name them.
    odom_and_base: Option<[String; 2]>,
    /// Frame of the LiDAR, as its messages name it.
    lidar: Option<String>,
    /// `world_from_lidar` by capture time; absent ones are of sweeps without a pose.
    waiting: VecDeque<(u64, Option<Isometry3<f64>>)>,
    map_from_odom: Option<Isometry3<f64>>,
    /// The reason that was logged last.
    logged: String,
}

/// Reason why an odometry frame has no place in the map.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
enum NoPlace {
    #[error("no message of its odometry has named its frames yet")]
    NoOdometry,
    #[error(transparent)]
    NoTransform(#[from] NoTransform),
}

impl RobotFrames {
    /// Frames of `robots`. `mount` is the place of their LiDARs on their bodies; without it that of tf holds.
    pub(super) fn of(robots: impl Iterator<Item = CavId>, mount: Option<Mount>) -> Self {
        let state = FramesState {
            robots: robots.map(|cav| (cav, Robot::default())).collect(),
            ..FramesState::default()
        };
        Self {
            state: Arc::new(Mutex::new(state)),
            mount,
        }
    }

    /// Listens to tf, if there are robots.
    pub(super) fn listen(&self, session: &RosSession) -> Result<Vec<RosSubscription>, BusError> {
        let topics = [
            (RosTopic::Tf, Qos::TF, Origin::Moving),
            (RosTopic::TfStatic, Qos::TF_STATIC, Origin::Fixed),
        ];
        let is_needed = !lock(&self.state).robots.is_empty();
        let topics = topics.into_iter().filter(|_| is_needed);
        let subscriptions = topics.map(|(topic, qos, origin)| {
            let frames = self.clone();
            session.subscribe(&topic.name(None), RosType::TfMessage, qos, move |sample| {
                frames.note_transforms(&sample.payload().to_bytes(), origin);
            })
        });
        subscriptions.collect()
    }

    fn note_transforms(&self, bytes: &[u8], origin: Origin) {
        match PoseType::TfMessage.read(bytes) {
            Ok(transforms) => {
                let mut state = lock(&self.state);
                for transform in &transforms {
                    state.tree.add(transform, origin);
                }
            }
            Err(error) => tracing::debug!("a message of tf is left out: {error}"),
        }
    }

    /// A message of a robot's odometry: names of its frames, and its pose where tf has none.
    pub(super) fn note_odometry(&self, cav: &CavId, bytes: &[u8]) {
        // An unreadable message is named by the reader of its motion.
        for transform in PoseType::Odometry.read(bytes).unwrap_or_default() {
            lock(&self.state).note_odometry(cav, &transform);
        }
    }

    /// The frame of a robot's LiDAR.
    pub(super) fn note_lidar(&self, cav: &CavId, frame: &str) {
        if let Some(robot) = lock(&self.state).robots.get_mut(cav) {
            robot.lidar = Some(frame.to_owned());
        }
    }

    /// `world_from_lidar` of a sweep of a vehicle; `None`: the sweep has no pose.
    pub(super) fn note_pose(&self, cav: &CavId, nanos: u64, pose: Option<Isometry3<f64>>) {
        let mut state = lock(&self.state);
        let Some(robot) = state.robots.get_mut(cav) else {
            return;
        };
        robot.waiting.push_back((nanos, pose));
        if robot.waiting.len() > MOST_WAITING {
            robot.waiting.pop_front();
            state.unplaced += 1;
        }
    }

    /// Transforms from `map` to odometry frames that have become known, with their stamps, nanoseconds. A sweep without a
    /// pose repeats the one before: the robot goes on by its odometry.
    pub(super) fn odometry_in_map(&self) -> Vec<(u64, FrameInParent)> {
        let mut state = lock(&self.state);
        let state = &mut *state;
        let mut found = Vec::new();
        for (cav, robot) in &mut state.robots {
            while let Some((nanos, pose)) = robot.waiting.front().copied() {
                match pose
                    .map(|pose| robot.map_from_odom(&state.tree, self.mount.as_ref(), nanos, &pose))
                {
                    // Its transforms may still come. Later poses wait behind it, in order.
                    Some(Err(NoPlace::NoTransform(NoTransform::Later { .. }))) => break,
                    Some(Ok(map_from_odom)) => robot.map_from_odom = Some(map_from_odom),
                    Some(Err(reason)) => {
                        state.unplaced += 1;
                        robot.log(cav, &reason);
                    }
                    None => {}
                }
                robot.waiting.pop_front();
                found.extend(robot.in_map().map(|frame| (nanos + VALID_NANOS, frame)));
            }
        }
        found
    }

    /// Frames of the vehicles' LiDARs under `names` in the robots' own frames, of those robots whose frames are known.
    pub(super) fn lidars_in_robots(&self, names: &FrameNames) -> BTreeMap<CavId, FrameInParent> {
        let state = lock(&self.state);
        let placed = state.robots.iter().filter_map(|(cav, robot)| {
            let (parent, parent_from_lidar) = robot.lidar_place(self.mount.as_ref())?;
            let (parent, lidar) = (parent.to_owned(), names.lidar(cav));
            Some((cav.clone(), (parent, lidar, parent_from_lidar.into())))
        });
        placed.collect()
    }

    /// Place of a vehicle's LiDAR on its body: as configured, else by tf, else its origin.
    pub(super) fn base_from_lidar(&self, cav: &CavId, nanos: u64) -> Isometry3<f64> {
        if let Some(mount) = &self.mount {
            return mount.base_from_lidar.isometry();
        }
        let state = lock(&self.state);
        let found = state.robots.get(cav).and_then(|robot| {
            let [_, base] = robot.odom_and_base.as_ref()?;
            state.tree.at(nanos, base, robot.lidar.as_ref()?).ok()
        });
        found.unwrap_or_else(Isometry3::identity)
    }

    /// Poses so far for which there were no transforms.
    pub(super) fn unplaced(&self) -> u64 {
        lock(&self.state).unplaced
    }
}

impl FramesState {
    fn note_odometry(&mut self, cav: &CavId, transform: &Transform) {
        self.tree.add(transform, Origin::Odometry);
        let Some(base) = &transform.child else { return };
        let odom = &transform.parent;
        // A frame has one parent: two robots, or the map, cannot have it as their odometry.
        let is_taken = odom == MAP_FRAME
            || self.robots.iter().any(|(other, robot)| {
                other != cav && matches!(&robot.odom_and_base, Some([taken, _]) if taken == odom)
            });
        let Some(robot) = self.robots.get_mut(cav) else {
            return;
        };
        if is_taken {
            let reason =
                format!("frame {odom:?} of its odometry is that of another robot, or the map");
            return robot.log(cav, &reason);
        }
        robot.odom_and_base = Some([odom, base].map(String::clone));
    }
}

impl Robot {
    /// The frame to which the LiDAR is fixed, and the LiDAR's place in it.
    fn lidar_place(&self, mount: Option<&Mount>) -> Option<(&str, Isometry3<f64>)> {
        let [_, base] = self.odom_and_base.as_ref()?;
        match mount {
            Some(mount) => Some((base, mount.base_from_lidar.isometry())),
            // Without a mount tf has the LiDAR under its own name.
            None => Some((self.lidar.as_deref()?, Isometry3::identity())),
        }
    }

    fn map_from_odom(
        &self,
        tree: &TransformTree,
        mount: Option<&Mount>,
        nanos: u64,
        world_from_lidar: &Isometry3<f64>,
    ) -> Result<Isometry3<f64>, NoPlace> {
        let [odom, _] = self.odom_and_base.as_ref().ok_or(NoPlace::NoOdometry)?;
        let (frame, frame_from_lidar) = self.lidar_place(mount).ok_or(NoPlace::NoOdometry)?;
        let odom_from_lidar = tree.at(nanos, odom, frame)? * frame_from_lidar;
        // map_from_odom = map_from_lidar * lidar_from_odom, with the world frame as the map.
        Ok(world_from_lidar * odom_from_lidar.inverse())
    }

    fn in_map(&self) -> Option<FrameInParent> {
        let [odom, _] = self.odom_and_base.as_ref()?;
        let map_from_odom = self.map_from_odom?.into();
        Some((MAP_FRAME.to_owned(), odom.clone(), map_from_odom))
    }

    /// Logs a reason once until another one follows.
    fn log(&mut self, cav: &CavId, reason: &dyn std::fmt::Display) {
        let text = reason.to_string();
        if self.logged != text {
            tracing::warn!("the odometry frame of {cav} has no place in the map: {text}");
            self.logged = text;
        }
    }
}

#[cfg(test)]
mod tests;
