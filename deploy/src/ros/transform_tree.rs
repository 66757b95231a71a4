//! Transform tree: the frames of robots as tf and their odometry publish them, and where one is in another at a time.

use std::collections::BTreeMap;

use nalgebra::Isometry3;
use ros2::Transform;

use super::time_series::{NoPose, TimeSeries};

/// Most frames that are kept: those of many robots.
const MOST_FRAMES: usize = 4096;
/// Longest way from a frame to another one.
const MOST_STEPS: usize = 64;

/// Origin of a transform; of two for one frame the later in this order holds.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub(super) enum Origin {
    /// Pose of an odometry message, for robots that publish no tf.
    Odometry,
    /// `/tf`.
    Moving,
    /// `/tf_static`.
    Fixed,
}

/// Frames by name.
#[derive(Debug, Default)]
pub(super) struct TransformTree(BTreeMap<String, TreeFrame>);

/// A frame in its parent.
#[derive(Debug)]
struct TreeFrame {
    parent: String,
    origin: Origin,
    parent_from_frame: TimeSeries<Isometry3<f64>>,
}

/// Reason why the place of a frame is not known.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub(super) enum NoTransform {
    /// It may still come.
    #[error("the transform of {frame:?} in {parent:?} is older than the sweep")]
    Later { frame: String, parent: String },
    /// No transform is near that time.
    #[error(
        "no transform of {frame:?} in {parent:?} from before and after the sweep, at most 1 s apart"
    )]
    Gap { frame: String, parent: String },
    /// There is no way from one to the other.
    #[error("{from:?} has no place in {to:?}: {end:?} has no parent on /tf or /tf_static")]
    NoWay {
        from: String,
        to: String,
        end: String,
    },
}

impl TransformTree {
    /// Adds a transform; false if it is none, or there is no place for another frame.
    pub(super) fn add(&mut self, transform: &Transform, origin: Origin) -> bool {
        let (parent, Some(child)) = (&transform.parent, &transform.child) else {
            return false;
        };
        let is_known = self.0.contains_key(child);
        if transform.parent_from_child.validate().is_err()
            || parent == child
            || !is_known && self.0.len() >= MOST_FRAMES
        {
            return false;
        }
        let frame = self.0.entry(child.clone());
        let frame = frame.or_insert_with(|| TreeFrame::below(parent, origin));
        // The frame has its place from a better origin: valid, but left out.
        if frame.origin > origin {
            return true;
        }
        // Under another parent, or from a better origin, the old poses mean nothing.
        if frame.origin != origin || frame.parent != *parent {
            *frame = TreeFrame::below(parent, origin);
        }
        let pose = transform.parent_from_child.isometry();
        frame.parent_from_frame.add(transform.nanos, pose);
        true
    }

    /// `ancestor_from_frame` at a time.
    pub(super) fn at(
        &self,
        nanos: u64,
        ancestor: &str,
        frame: &str,
    ) -> Result<Isometry3<f64>, NoTransform> {
        let (mut end, mut end_from_frame) = (frame, Isometry3::identity());
        // Frames that are each other's parents would have no end.
        for _ in 0..MOST_STEPS {
            if end == ancestor {
                return Ok(end_from_frame);
            }
            let Some(step) = self.0.get(end) else { break };
            // From the frame upwards: parent_from_frame = parent_from_end * end_from_frame.
            end_from_frame = step.at(nanos, end)? * end_from_frame;
            end = &step.parent;
        }
        Err(NoTransform::NoWay {
            from: frame.to_owned(),
            to: ancestor.to_owned(),
            end: end.to_owned(),
        })
    }
}

impl TreeFrame {
    fn below(parent: &str, origin: Origin) -> Self {
        Self {
            parent: parent.to_owned(),
            origin,
            parent_from_frame: TimeSeries::default(),
        }
    }

    fn at(&self, nanos: u64, name: &str) -> Result<Isometry3<f64>, NoTransform> {
        // A fixed transform holds at all times.
        let found = match self.origin {
            Origin::Fixed => self.parent_from_frame.last().ok_or(NoPose::Later),
            Origin::Odometry | Origin::Moving => self.parent_from_frame.at(nanos),
        };
        let (frame, parent) = (name.to_owned(), self.parent.clone());
        found.map_err(|reason| match reason {
            NoPose::Later => NoTransform::Later { frame, parent },
            NoPose::Never => NoTransform::Gap { frame, parent },
        })
    }
}

#[cfg(test)]
mod tests {
    use protocol::Pose;

    use super::*;

    const S: u64 = 1_000_000_000;

    fn transform(nanos: u64, [parent, child]: [&str; 2], x: f64) -> Transform {
        Transform {
            nanos,
            parent: parent.into(),
            child: Some(child.into()),
            parent_from_child: Pose::from_xyz_yaw([x, 0.0, 0.0], 0.0),
        }
    }

    fn robot() -> TransformTree {
        let mut tree = TransformTree::default();
        for (nanos, x) in [(S, 10.0), (2 * S, 20.0)] {
            let odometry = transform(nanos, ["odom", "base_link"], x);
            assert!(tree.add(&odometry, Origin::Moving));
        }
        let lidar = transform(0, ["base_link", "velodyne"], 1.5);
        assert!(tree.add(&lidar, Origin::Fixed));
        tree
    }

    #[test]
    fn a_frame_is_found_through_all_between_at_the_time_of_the_sweep() {
        let tree = robot();
        let pose = tree.at(S + S / 2, "odom", "velodyne").unwrap();
        assert_eq!(pose.translation.x, 16.5);
        let later = tree.at(3 * S, "odom", "velodyne").unwrap_err();
        assert!(matches!(later, NoTransform::Later { frame, .. } if frame == "base_link"));
        let gap = tree.at(S / 2, "odom", "velodyne").unwrap_err();
        assert!(matches!(gap, NoTransform::Gap { .. }));
        let error = tree.at(S, "odom", "camera").unwrap_err().to_string();
        assert!(error.contains("\"camera\" has no parent"), "{error}");
    }

    #[test]
    fn tf_replaces_the_pose_of_the_odometry_and_not_the_other_way() {
        let mut tree = robot();
        assert!(tree.add(&transform(S, ["odom", "base_link"], 99.0), Origin::Odometry));
        let x = tree.at(S, "odom", "base_link").unwrap().translation.x;
        assert_eq!(x, 10.0);
        assert!(tree.add(&transform(S, ["odom", "wheels"], 7.0), Origin::Odometry));
        assert!(tree.add(&transform(S, ["base_link", "wheels"], 1.0), Origin::Moving));
        assert_eq!(tree.at(S, "odom", "wheels").unwrap().translation.x, 11.0);
    }

    #[test]
    fn what_is_no_transform_is_left_out_and_a_ring_has_an_end() {
        let mut tree = robot();
        let mut turned = transform(S, ["odom", "base_link"], 5.0);
        turned.parent_from_child.rotation_wxyz = [0.0; 4];
        assert!(!tree.add(&turned, Origin::Moving));
        assert!(!tree.add(&transform(S, ["a", "a"], 0.0), Origin::Moving));
        for ring in [["a", "b"], ["b", "a"]] {
            assert!(tree.add(&transform(S, ring, 0.0), Origin::Moving));
        }
        assert!(matches!(
            tree.at(S, "odom", "a"),
            Err(NoTransform::NoWay { .. })
        ));
    }
}
