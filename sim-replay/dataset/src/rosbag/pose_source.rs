//! Sources of poses in a bag: topics of odometry and poses, and chains of transforms, from the world to the LiDAR.

use std::cmp::Reverse;
use std::collections::BTreeMap;
use std::path::Path;

use nalgebra::Isometry3;

use super::contents::{BagContents, PoseStamp};
use super::sweeps::{STRAY, SweepTopic, most_frequent};
use super::transforms::{FrameRoute, Motion, Transforms, is_map};
use crate::ReadError;
use crate::trajectory::{Trajectory, Unposed};

/// Largest time between two poses over which they are interpolated, nanoseconds: that of poses at 1 Hz and their jitter.
pub(super) const MAX_GAP_NANOS: u64 = 1_250_000_000;
/// Frames of a robot's body that a pose without a child frame belongs to.
const BODIES: [&str; 2] = ["base_link", "base_footprint"];

/// A source of poses of the LiDAR.
#[derive(Debug)]
pub(super) struct LidarPoseSource {
    /// Topic and frames, for messages.
    pub(super) name: String,
    world: String,
    /// True if its messages name the frame that moves.
    is_named: bool,
    /// Number of poses.
    pub(super) poses: usize,
    /// Times of its first and last pose, nanoseconds.
    pub(super) span: Option<(u64, u64)>,
    /// `world_from_child`; `None` where all of the way is transforms.
    world_from_child: Option<Trajectory>,
    /// From child, or world, to the LiDAR.
    route: FrameRoute,
}

impl LidarPoseSource {
    /// `world_from_lidar` at a time, nanoseconds.
    pub(super) fn at(&self, transforms: &Transforms, time: u64) -> Result<Isometry3<f64>, Unposed> {
        // At the time of the sweep too: joints between body and LiDAR may move.
        let rest = transforms.along(&self.route, time)?;
        Ok(match &self.world_from_child {
            Some(poses) => poses.at(time)? * rest,
            None => rest,
        })
    }

    /// Sources of maps come before those of odometry, those of many poses before those of few.
    pub(super) fn rank(&self) -> impl Ord + use<> {
        let name = Reverse(self.name.clone());
        (is_map(&self.world), self.poses, self.is_named, name)
    }
}

/// All that can give poses to the sweeps of one topic.
#[derive(Debug, Default)]
pub(super) struct PoseSources {
    pub(super) transforms: Transforms,
    pub(super) sources: Vec<LidarPoseSource>,
    /// Topics that cannot, with the reason.
    pub(super) unusable: Vec<String>,
    /// Poses that were left out.
    pub(super) problems: Vec<ReadError>,
}

impl PoseSources {
    /// Sources of the poses of the LiDAR that recorded `sweeps`.
    pub(super) fn of(path: &Path, contents: &BagContents, sweeps: &SweepTopic) -> Self {
        let mut sources = Self::default();
        sources.add_fixed(path, &contents.fixed);
        sources.add_moving(path, &contents.moving, sweeps);
        let frame = &sweeps.frame;
        let chains = sources.transforms.worlds_of(frame);
        sources.sources = chains
            .into_iter()
            .map(|(world, route)| {
                // A chain has no more poses than its sparsest trajectory.
                let sparsest = sources.transforms.sparsest(&route);
                LidarPoseSource {
                    name: format!("transforms ({frame} in {world})"),
                    world: world.to_owned(),
                    is_named: true,
                    poses: sparsest.map_or(0, Trajectory::len),
                    span: sparsest.and_then(Trajectory::span),
                    world_from_child: None,
                    route,
                }
            })
            .collect();
        if sources.sources.is_empty() && !contents.moving.is_empty() {
            let reason = format!("transforms: none leads from {frame} to a map or odometry");
            sources.unusable.push(reason);
        }
        for (topic, poses) in &contents.poses {
            match sources.of_topic(path, (topic, poses), sweeps) {
                Ok(source) => sources.sources.push(source),
                Err(reason) => sources.unusable.push(format!("{topic}: {reason}")),
            }
        }
        sources
    }

    /// Of several messages about one fixed transform the last counts, as in tf2.
    fn add_fixed(&mut self, path: &Path, fixed: &[PoseStamp]) {
        let mut last: BTreeMap<(&str, &str), Isometry3<f64>> = BTreeMap::new();
        for pose in fixed {
            let Some(child) = pose.child.as_deref() else {
                continue;
            };
            let parent = pose.parent.as_str();
            let before = last.insert((parent, child), pose.parent_from_child);
            if before.is_some_and(|before| !is_same(&before, &pose.parent_from_child)) {
                let reason = format!("tf_static: {child} in {parent} changes: the last is used");
                self.problems.push(ReadError::malformed(path, reason));
            }
        }
        for ((parent, child), pose) in last {
            self.transforms.add(parent, child, Motion::Fixed(pose));
        }
    }

    fn add_moving(&mut self, path: &Path, moving: &[PoseStamp], sweeps: &SweepTopic) {
        let mut by_frames: BTreeMap<(&str, &str), Vec<&PoseStamp>> = BTreeMap::new();
        for pose in moving {
            if let Some(child) = pose.child.as_deref() {
                let poses = by_frames.entry((&pose.parent, child));
                poses.or_default().push(pose);
            }
        }
        for ((parent, child), poses) in by_frames {
            let name = format!("transforms of {child} in {parent}");
            let motion = Motion::Moving(self.trajectory(path, &name, &poses, sweeps));
            self.transforms.add(parent, child, motion);
        }
    }

    /// The source that a topic of odometry or poses is.
    fn of_topic(
        &mut self,
        path: &Path,
        (topic, poses): (&str, &[PoseStamp]),
        sweeps: &SweepTopic,
    ) -> Result<LidarPoseSource, String> {
        let world = most_frequent(poses.iter().map(|pose| pose.parent.as_str()));
        let child = most_frequent(poses.iter().map(|pose| pose.child.as_deref().unwrap_or("")));
        let of_frames = poses
            .iter()
            .filter(|pose| pose.parent == world && pose.child.as_deref().unwrap_or("") == child);
        let of_frames: Vec<&PoseStamp> = of_frames.collect();
        let others = poses.len() - of_frames.len();
        if others > 0 {
            let reason = format!(
                "{topic}: {others} poses are of other frames than {child} in {world}: left out"
            );
            self.problems.push(ReadError::malformed(path, reason));
        }
        let is_named = !child.is_empty();
        let (child, unnamed) = match is_named {
            true => (child, ""),
            false => (
                self.body_of(&sweeps.frame),
                ", which the messages do not name",
            ),
        };
        let frame = &sweeps.frame;
        let route = self.transforms.route_down(&child, frame).ok_or_else(|| {
            format!("no transform between {child} and {frame}, the frame of the sweeps")
        })?;
        let trajectory = self.trajectory(path, topic, &of_frames, sweeps);
        Ok(LidarPoseSource {
            name: format!("{topic} ({child} in {world}{unnamed})"),
            world,
            is_named,
            poses: trajectory.len(),
            span: trajectory.span(),
            world_from_child: Some(trajectory),
            route,
        })
    }

    /// The body that carries a LiDAR, or its own frame where no transform names it.
    fn body_of(&self, frame: &str) -> String {
        let mut bodies = BODIES.iter();
        let body = bodies.find_map(|body| self.transforms.find(body, frame));
        body.unwrap_or(frame).to_owned()
    }

    /// The poses of the sweeps' clock, in order. Those without a stamp or out of order are left out and counted.
    fn trajectory(
        &mut self,
        path: &Path,
        name: &str,
        poses: &[&PoseStamp],
        sweeps: &SweepTopic,
    ) -> Trajectory {
        let of_clock = poses
            .iter()
            .filter(|pose| sweeps.is_of_its_clock(pose.recorded_nanos));
        let mut timed: Vec<(u64, Isometry3<f64>)> = of_clock
            .filter(|pose| pose.nanos > 0)
            .map(|pose| (pose.nanos, pose.parent_from_child))
            .collect();
        let unstamped = poses.iter().filter(|pose| pose.nanos == 0).count();
        // Publishers repeat what has not changed.
        timed.dedup_by(|next, last| next.0 == last.0 && is_same(&next.1, &last.1));
        let (trajectory, out_of_order) = Trajectory::new(timed, MAX_GAP_NANOS);
        for (count, reason) in [(unstamped, "have the stamp 0"), (out_of_order.len(), STRAY)] {
            if count > 0 {
                let all = poses.len();
                let reason = format!("{name}: {count} of {all} poses {reason}: left out");
                self.problems.push(ReadError::malformed(path, reason));
            }
        }
        trajectory
    }
}

/// True up to rounding: micrometres and microradians.
fn is_same(one: &Isometry3<f64>, other: &Isometry3<f64>) -> bool {
    (one.translation.vector - other.translation.vector).amax() < 1e-6
        && one.rotation.angle_to(&other.rotation) < 1e-6
}
