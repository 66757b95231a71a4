//! Ground truth: the annotations of all CAVs in range, merged into the objects that an ego is expected to find.
//!
//! The rule is OpenCOOD's at test time (`opencood/data_utils/post_processor/base_postprocessor.py`,
//! `opencood/utils/box_utils.py`): annotations of the current tick, moved by true poses, reduced to upright boxes in
//! the ego's LiDAR frame, kept where their corners lie in range, merged by id. The ego itself is not removed: where a
//! partner lists it, it is an object near the origin.
//!
//! Data sets with a cooperative annotation of a tick (DAIR-V2X, V2X-Seq) are evaluated by that list alone, as their
//! public protocols do: see [`annotations`].

use std::collections::HashSet;

use nalgebra::{Isometry3, Vector3};
use protocol::Box3d;
use serde::{Deserialize, Serialize};

use crate::class_set::ClassSet;
use crate::frame::{Frame, Object};

/// Range, classes and agents whose annotations count.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct GroundTruthRule {
    /// Lower and upper end of x in the ego's LiDAR frame, metres, both included.
    pub x_m: [f64; 2],
    /// The same for y.
    pub y_m: [f64; 2],
    /// The same for z.
    pub z_m: [f64; 2],
    /// CAVs farther than this from the ego, in the plane, do not contribute, metres.
    pub comm_range_m: f64,
    /// Number of a box's 8 corners that must lie within x, y and z.
    pub min_corners: usize,
    /// Classes of the objects that count.
    pub classes: ClassSet,
}

impl GroundTruthRule {
    /// OPV2V and V2XSet: x within 140 m, y within 40 m, z -3..1 m, all corners, 70 m of communication.
    pub const OPV2V: Self = Self {
        x_m: [-140.0, 140.0],
        y_m: [-40.0, 40.0],
        z_m: [-3.0, 1.0],
        comm_range_m: 70.0,
        min_corners: 8,
        classes: ClassSet::VEHICLES,
    };
    /// V2V4Real: x within 100 m, y within 40 m, z -5..3 m, two corners, 70 m of communication.
    pub const V2V4REAL: Self = Self {
        x_m: [-100.0, 100.0],
        y_m: [-40.0, 40.0],
        z_m: [-5.0, 3.0],
        comm_range_m: 70.0,
        min_corners: 2,
        classes: ClassSet::ALL_BUT_PEDESTRIANS,
    };

    /// True if enough corners lie in range, and all of them in x and y.
    #[must_use]
    pub fn keeps(&self, box3d: &Box3d) -> bool {
        let corners = box3d.corners();
        let within = |value: f64, [low, high]: [f64; 2]| low <= value && value <= high;
        let in_plane = |&[x, y, _]: &[f64; 3]| within(x, self.x_m) && within(y, self.y_m);
        let inside = corners
            .iter()
            .filter(|corner| in_plane(corner) && within(corner[2], self.z_m))
            .count();
        // The second test is the reference's own, on x and y alone, after merging. It decides only if fewer than all
        // corners pass the first one.
        inside >= self.min_corners && corners.iter().all(in_plane)
    }
}

/// The objects of one tick in the frame of the ego's LiDAR, by id, in the order of first occurrence: the ego's own
/// annotation first, then the other agents' in the order of `frames_of_tick`.
///
/// `frames_of_tick` are the frames of all agents at the tick, `ego_index` is the ego's index among them. Without a pose
/// of the ego the result is empty.
#[must_use]
pub fn merge(
    frames_of_tick: &[&Frame],
    ego_index: usize,
    rule: &GroundTruthRule,
) -> Vec<(i64, Box3d)> {
    merged_objects(frames_of_tick, ego_index, rule)
        .into_iter()
        .map(|(object, box3d)| (object.id, box3d))
        .collect()
}

/// [`merge`] with the annotation that each box is of.
#[must_use]
pub fn merged_objects<'a>(
    frames_of_tick: &[&'a Frame],
    ego_index: usize,
    rule: &GroundTruthRule,
) -> Vec<(&'a Object, Box3d)> {
    let Some(ego) = frames_of_tick.get(ego_index) else {
        return Vec::new();
    };
    let Some(world_from_ego) = ego.world_from_lidar else {
        return Vec::new();
    };
    let ego_from_world = world_from_ego.isometry().inverse();
    let annotations = annotations(frames_of_tick);
    let contributors = match frames_of_tick
        .iter()
        .position(|frame| frame.cooperative_objects.is_some())
    {
        // The list belongs to the tick, regardless of the agents in range.
        Some(holder) => vec![holder],
        None => contributors(frames_of_tick, ego_index, rule.comm_range_m),
    };
    let mut seen = HashSet::new();
    let mut merged = Vec::new();
    for index in contributors {
        let listed = annotations.get(index).copied().unwrap_or_default();
        for object in listed
            .iter()
            .filter(|object| rule.classes.contains(object.class))
        {
            let box3d = upright_box(object, &ego_from_world);
            if rule.keeps(&box3d) && seen.insert(object.id) {
                merged.push((object, box3d));
            }
        }
    }
    merged
}

/// The objects that each frame of a tick contributes to the ground truth: those its agent lists. If a frame holds the
/// cooperative annotation of the tick, it contributes that one, and the others nothing.
#[must_use]
pub fn annotations<'a>(frames_of_tick: &[&'a Frame]) -> Vec<&'a [Object]> {
    let holder = frames_of_tick
        .iter()
        .position(|frame| frame.cooperative_objects.is_some());
    let contribution =
        |(index, frame): (usize, &&'a Frame)| match (holder, &frame.cooperative_objects) {
            (None, _) => frame.objects.as_slice(),
            (Some(holder), Some(objects)) if holder == index => objects.as_slice(),
            _ => &[],
        };
    frames_of_tick
        .iter()
        .enumerate()
        .map(contribution)
        .collect()
}

/// Indices of the agents whose annotations count: the ego first, then those within range of it.
#[must_use]
pub fn contributors(frames_of_tick: &[&Frame], ego_index: usize, comm_range_m: f64) -> Vec<usize> {
    let position = |index: usize| {
        frames_of_tick
            .get(index)
            .and_then(|frame| frame.world_from_lidar)
    };
    let Some(ego) = position(ego_index) else {
        return Vec::new();
    };
    let in_range = |&index: &usize| {
        let Some(other) = position(index).filter(|_| index != ego_index) else {
            return false;
        };
        let ([x, y, _], [ego_x, ego_y, _]) = (other.translation_m, ego.translation_m);
        (x - ego_x).hypot(y - ego_y) <= comm_range_m
    };
    std::iter::once(ego_index)
        .chain((0..frames_of_tick.len()).filter(in_range))
        .collect()
}

/// The object as a box without roll and pitch in another frame.
///
/// The reference moves the 8 corners and takes means over them: centre, the planar lengths of the edges along length
/// and width, the height between the faces, and the direction of the four long edges. Those edges are parallel, so the
/// means are taken here from the rotation directly, which also spares the heading the reference's average of angles
/// without unwrapping near +-180 degrees.
#[must_use]
pub fn upright_box(object: &Object, target_from_world: &Isometry3<f64>) -> Box3d {
    let target_from_object = target_from_world * object.world_from_object.isometry();
    let [forward, left, up] =
        [Vector3::x(), Vector3::y(), Vector3::z()].map(|axis| target_from_object.rotation * axis);
    let [length, width, height] = object.size_m;
    Box3d {
        center_m: target_from_object.translation.vector.into(),
        size_m: [
            length * forward.xy().norm(),
            width * left.xy().norm(),
            height * up.z.abs(),
        ],
        heading_rad: forward.y.atan2(forward.x),
    }
}

#[cfg(test)]
mod tests {
    use protocol::{CavId, Handedness, Pose};

    use super::*;
    use crate::frame::ObjectClass;

    fn frame(cav: &str, x: f64, objects: Vec<Object>) -> Frame {
        Frame {
            world_from_lidar: Some(Pose::from_xyz_yaw([x, 0.0, 2.0], 0.0)),
            objects,
            ..Frame::empty(CavId::new(cav).unwrap(), 0, Handedness::Right)
        }
    }

    fn car(id: i64, x: f64, y: f64) -> Object {
        Object {
            id,
            class: ObjectClass::Car,
            world_from_object: Pose::from_xyz_yaw([x, y, 1.0], 0.0),
            size_m: [4.0, 2.0, 1.5],
            speed_mps: None,
        }
    }

    fn ids(frames: &[Frame], ego: usize, rule: &GroundTruthRule) -> Vec<i64> {
        merge(&frames.iter().collect::<Vec<_>>(), ego, rule)
            .into_iter()
            .map(|(id, _)| id)
            .collect()
    }

    #[test]
    fn annotations_merge_by_id_and_the_ego_stays() {
        let frames = [
            frame("1", 0.0, vec![car(7, 20.0, 0.0)]),
            frame("2", 50.0, vec![car(7, 20.0, 0.0), car(1, 0.0, 0.0)]),
        ];
        assert_eq!(ids(&frames, 0, &GroundTruthRule::OPV2V), [7, 1]);
        assert_eq!(ids(&frames[..1], 0, &GroundTruthRule::OPV2V), [7]);
        let seen_by_two = merge(&[&frames[0], &frames[1]], 1, &GroundTruthRule::OPV2V);
        assert_eq!(seen_by_two[0].1.center_m, [-30.0, 0.0, -1.0]);
    }

    #[test]
    fn a_cooperative_annotation_takes_the_place_of_all_others() {
        let mut frames = [
            frame("1", 0.0, vec![car(7, 20.0, 0.0)]),
            frame("2", 90.0, vec![car(8, 30.0, 0.0)]),
        ];
        frames[0].cooperative_objects = Some(vec![car(0, 20.0, 1.0), car(1, 30.0, 1.0)]);
        assert_eq!(ids(&frames, 0, &GroundTruthRule::OPV2V), [0, 1]);
        assert_eq!(
            ids(&frames, 1, &GroundTruthRule::OPV2V),
            [0, 1],
            "out of range, but the truth of the tick"
        );
        assert_eq!(ids(&frames[1..], 0, &GroundTruthRule::OPV2V), [8]);
        let [with_list, other] = annotations(&frames.each_ref())[..] else {
            panic!("one per frame")
        };
        assert_eq!((with_list.len(), other.len()), (2, 0));
    }

    #[test]
    fn agents_out_of_range_do_not_contribute() {
        let frames = [
            frame("1", 0.0, vec![]),
            frame("2", 70.0, vec![car(3, 5.0, 0.0)]),
            frame("3", 70.1, vec![car(4, 5.0, 0.0)]),
        ];
        assert_eq!(ids(&frames, 0, &GroundTruthRule::OPV2V), [3]);
    }

    #[test]
    fn every_corner_must_lie_in_range_border_included() {
        let inside = |x, y| {
            !ids(
                &[frame("1", 0.0, vec![car(1, x, y)])],
                0,
                &GroundTruthRule::OPV2V,
            )
            .is_empty()
        };
        assert!(inside(138.0, 39.0) && inside(-138.0, -39.0));
        assert!(!inside(138.1, 0.0) && !inside(0.0, 39.1));
        let mut high = car(1, 0.0, 0.0);
        high.size_m[2] = 4.5;
        assert!(
            ids(&[frame("1", 0.0, vec![high])], 0, &GroundTruthRule::OPV2V).is_empty(),
            "z counts as well"
        );
    }

    #[test]
    fn two_corners_do_for_v2v4real_but_x_and_y_need_all() {
        let rule = GroundTruthRule {
            z_m: [-1.0, 3.0],
            ..GroundTruthRule::V2V4REAL
        };
        assert_eq!(
            ids(&[frame("1", 0.0, vec![car(1, 10.0, 0.0)])], 0, &rule),
            [1],
            "the top face is above -1 m"
        );
        assert!(ids(&[frame("1", 0.0, vec![car(1, 99.0, 0.0)])], 0, &rule).is_empty());
    }

    #[test]
    fn pedestrians_are_no_targets() {
        let walker = Object {
            class: ObjectClass::Pedestrian,
            ..car(1, 5.0, 0.0)
        };
        assert!(ids(&[frame("1", 0.0, vec![walker])], 0, &GroundTruthRule::OPV2V).is_empty());
    }

    #[test]
    fn heading_is_right_at_half_a_turn() {
        for yaw in [std::f64::consts::PI, -std::f64::consts::PI, 3.0, -3.0] {
            let object = Object {
                world_from_object: Pose::from_xyz_yaw([0.0; 3], yaw),
                ..car(1, 0.0, 0.0)
            };
            let heading = upright_box(&object, &Isometry3::identity()).heading_rad;
            assert!(
                ((heading - yaw) / 2.0).sin().abs() < 1e-9,
                "{heading} {yaw}"
            );
        }
    }

    #[test]
    fn a_tilt_shortens_the_box_in_the_plane() {
        let tilt = Isometry3::rotation(Vector3::y() * 0.5);
        let object = Object {
            world_from_object: tilt.into(),
            ..car(1, 0.0, 0.0)
        };
        let [l, w, h] = upright_box(&object, &Isometry3::identity()).size_m;
        assert!(
            (l - 4.0 * 0.5f64.cos()).abs() < 1e-12
                && (w - 2.0).abs() < 1e-12
                && (h - 1.5 * 0.5f64.cos()).abs() < 1e-12
        );
    }
}
