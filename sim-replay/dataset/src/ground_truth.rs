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
use crate::frame::{Frame, Object, ObjectClass};

/// An annotated object in the LiDAR frame of an ego.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct TrueBox {
    /// Id of the object, see [`Object::id`].
    pub id: i64,
    /// Class of the object.
    pub class: ObjectClass,
    /// The object as an upright box.
    #[serde(flatten)]
    pub box3d: Box3d,
}

/// Ground truth of one frame: what detections are compared with, and which of them count.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct GroundTruth {
    /// Objects that an ego is expected to find.
    #[serde(rename = "boxes")]
    pub objects: Vec<TrueBox>,
    /// Objects of classes that do not count, of which no agent's annotation makes them one that does. A detection on one
    /// of them is neither right nor wrong.
    pub ignored: Vec<TrueBox>,
    /// Range of the objects: x, y of the lower, then of the upper corner, metres. Detections with a corner beyond it do
    /// not count.
    pub area_m: [f64; 4],
}

impl GroundTruth {
    /// The ground truth of a tick for an ego, see [`merged_objects`]. Without a true pose of the ego nothing tells where the true
    /// objects are: then no detection counts.
    pub fn of_tick(frames_of_tick: &[&Frame], ego_index: usize, rule: &GroundTruthRule) -> Self {
        let ego = frames_of_tick.get(ego_index);
        let pose = ego.and_then(|ego| ego.world_from_lidar);
        let ([x_low, x_high], [y_low, y_high]) = (rule.x_m, rule.y_m);
        let objects = true_boxes(&merged_objects(frames_of_tick, ego_index, rule));
        let counted: HashSet<i64> = objects.iter().map(|object| object.id).collect();
        // Without the test of the range: an object at its border still excuses a detection.
        let ignored = select(
            frames_of_tick,
            (ego_index, rule.comm_range_m),
            |object| !rule.classes.contains(object.class) && !counted.contains(&object.id),
            |_| true,
        );
        Self {
            objects,
            ignored: true_boxes(&ignored),
            area_m: match pose {
                Some(_) => [x_low, y_low, x_high, y_high],
                // Nothing lies in this range.
                None => [f64::MAX, f64::MAX, f64::MIN, f64::MIN],
            },
        }
    }

    /// Boxes of unknown class in an unlimited area: all detections count.
    pub fn of_boxes(boxes: impl IntoIterator<Item = Box3d>) -> Self {
        let objects = boxes.into_iter().zip(0..).map(|(box3d, id)| TrueBox {
            id,
            class: ObjectClass::Other,
            box3d,
        });
        Self {
            objects: objects.collect(),
            ignored: Vec::new(),
            area_m: [f64::MIN, f64::MIN, f64::MAX, f64::MAX],
        }
    }

    /// The boxes of the objects that count.
    pub fn boxes(&self) -> impl Iterator<Item = Box3d> {
        self.objects.iter().map(|object| object.box3d)
    }
}

fn true_boxes(objects: &[(&Object, Box3d)]) -> Vec<TrueBox> {
    let boxes = objects.iter().map(|&(object, box3d)| TrueBox {
        id: object.id,
        class: object.class,
        box3d,
    });
    boxes.collect()
}

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
    pub const OPV2V: Self = vehicles_in(140.0, 40.0, [-3.0, 1.0], 70.0);
    /// V2V4Real: x within 100 m, y within 40 m, z -5..3 m, two corners, 70 m of communication.
    pub const V2V4REAL: Self = Self {
        min_corners: 2,
        classes: ClassSet::ALL_BUT_PEDESTRIANS,
        ..vehicles_in(100.0, 40.0, [-5.0, 3.0], 70.0)
    };

    /// True if enough corners lie in range, and all of them in x and y.
    pub fn keeps(&self, box3d: &Box3d) -> bool {
        let (mut inside, mut are_in_plane) = (0, true);
        let is_within = |value: f64, [low, high]: [f64; 2]| (low..=high).contains(&value);
        for [x, y, z] in box3d.corners() {
            let is_in_plane = is_within(x, self.x_m) && is_within(y, self.y_m);
            inside += usize::from(is_in_plane && is_within(z, self.z_m));
            are_in_plane &= is_in_plane;
        }
        // The second test is the reference's own, on x and y alone, after merging. It decides only if fewer than all
        // corners pass the first one.
        inside >= self.min_corners && are_in_plane
    }
}

/// The rule for vehicles with all corners within x and y to both sides.
pub(crate) const fn vehicles_in(
    x: f64,
    y: f64,
    z_m: [f64; 2],
    comm_range_m: f64,
) -> GroundTruthRule {
    GroundTruthRule {
        x_m: [-x, x],
        y_m: [-y, y],
        z_m,
        comm_range_m,
        min_corners: 8,
        classes: ClassSet::VEHICLES,
    }
}

/// The objects of one tick, by id, with their boxes in the frame of the ego's LiDAR, in the order of first occurrence:
/// the ego's own annotation first, then the other agents' in the order of `frames_of_tick`.
///
/// `frames_of_tick` are the frames of all agents at the tick, `ego_index` is the ego's index among them. Without a pose
/// of the ego the result is empty.
pub fn merged_objects<'a>(
    frames_of_tick: &[&'a Frame],
    ego_index: usize,
    rule: &GroundTruthRule,
) -> Vec<(&'a Object, Box3d)> {
    select(
        frames_of_tick,
        (ego_index, rule.comm_range_m),
        |object| rule.classes.contains(object.class),
        |box3d| rule.keeps(box3d),
    )
}

/// Some of the objects that agents in range annotate, with the boxes that are kept; the first of each id.
fn select<'a>(
    frames_of_tick: &[&'a Frame],
    (ego_index, comm_range_m): (usize, f64),
    is_asked_for: impl Fn(&Object) -> bool,
    is_kept: impl Fn(&Box3d) -> bool,
) -> Vec<(&'a Object, Box3d)> {
    let ego = frames_of_tick.get(ego_index);
    let Some(world_from_ego) = ego.and_then(|ego| ego.world_from_lidar) else {
        return Vec::new();
    };
    let ego_from_world = world_from_ego.isometry().inverse();
    let annotations = annotations(frames_of_tick);
    let contributors = match cooperative_holder(frames_of_tick) {
        // The list belongs to the tick, regardless of the agents in range.
        Some(holder) => vec![holder],
        None => contributors(frames_of_tick, ego_index, comm_range_m),
    };
    let mut seen = HashSet::new();
    let mut merged = Vec::new();
    for index in contributors {
        let listed = annotations.get(index).copied().unwrap_or_default();
        for object in listed.iter().filter(|object| is_asked_for(object)) {
            let box3d = upright_box(object, &ego_from_world);
            // In this order: a box that is not kept leaves its id to the annotation of another agent.
            if is_kept(&box3d) && seen.insert(object.id) {
                merged.push((object, box3d));
            }
        }
    }
    merged
}

/// The objects that each frame of a tick contributes to the ground truth: those its agent lists. If a frame holds the
/// cooperative annotation of the tick, it contributes that one, and the others nothing.
pub fn annotations<'a>(frames_of_tick: &[&'a Frame]) -> Vec<&'a [Object]> {
    let holder = cooperative_holder(frames_of_tick);
    let lists = frames_of_tick.iter().zip(0..);
    lists
        .map(|(frame, index)| match holder {
            None => frame.objects.as_slice(),
            Some(holder) if holder == index => {
                frame.cooperative_objects.as_deref().unwrap_or_default()
            }
            Some(_) => &[],
        })
        .collect()
}

/// Index of the frame that holds the cooperative annotation of a tick.
fn cooperative_holder(frames_of_tick: &[&Frame]) -> Option<usize> {
    let mut frames = frames_of_tick.iter();
    frames.position(|frame| frame.cooperative_objects.is_some())
}

/// Indices of the agents whose annotations count: the ego first, then those within range of it.
pub fn contributors(frames_of_tick: &[&Frame], ego_index: usize, comm_range_m: f64) -> Vec<usize> {
    let ego = frames_of_tick.get(ego_index);
    let Some(ego) = ego.and_then(|ego| ego.world_from_lidar) else {
        return Vec::new();
    };
    let mut agents = vec![ego_index];
    for (index, frame) in frames_of_tick.iter().enumerate() {
        let Some(other) = frame.world_from_lidar.filter(|_| index != ego_index) else {
            continue;
        };
        if ego.planar_distance_m(&other) <= comm_range_m {
            agents.push(index);
        }
    }
    agents
}

/// The object as a box without roll and pitch in another frame.
///
/// The reference moves the 8 corners and takes means over them: centre, the planar lengths of the edges along length
/// and width, the height between the faces, and the direction of the four long edges. Those edges are parallel, so the
/// means are taken here from the rotation directly, which also spares the heading the reference's average of angles
/// without unwrapping near +-180 degrees.
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
mod tests;
