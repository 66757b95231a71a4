//! Labels of DAIR-V2X and V2X-Seq: lists of boxes in the world or in a LiDAR frame.

use std::path::Path;

use nalgebra::{Isometry3, Matrix3, Rotation3, Translation3, UnitQuaternion, Vector3};
use protocol::Pose;

use crate::frame::{Object, ObjectClass};
use crate::ground_truth::upright_box;
use crate::json::{self, JsonField};
use crate::poses::{self, box_angle_rad};
use crate::{Problem, ReadError, Result, classes, repeats};
use protocol::rotated_iou::Polygon;

/// Most boxes of a file.
const MAX_BOXES: usize = 10_000;
/// Largest deviation of the angles of a box's corners from 90 degrees, as a cosine.
const MAX_SKEW: f64 = 0.1;
/// Ids of a list are `block + number`. Blocks are farther apart than any number.
const BLOCK: i64 = 1 << 40;
/// Boxes of the two sides that overlap more than this, seen from above, are one object: the threshold with which the
/// public evaluation merges the two lists.
const SAME_OBJECT_IOU: f64 = 0.05;

/// Valid objects, and the faults of the others.
pub(super) type LabelledObjects = (Vec<Object>, Vec<Problem>);

/// Number in the list or track, pose in the world and size of a labelled box.
type LabelledBox = (i64, Pose, [f64; 3]);

/// Source of a list. The lists number their objects independently, so each has its own range of ids.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum LabelList {
    Cooperative,
    Vehicle,
    Infrastructure,
}

impl LabelList {
    pub(super) fn id(self, number: i64) -> i64 {
        number.saturating_add(self as i64 * BLOCK)
    }
}

/// Cooperative labels of DAIR-V2X: eight corners in the world. They have no ids: the number in the list serves as one,
/// and does not identify the object at another tick.
pub(super) fn in_world(path: &Path) -> Result<LabelledObjects> {
    read(path, LabelList::Cooperative, |number, label| {
        let found = from_corners(&label.required("world_8_points")?)?;
        Ok(found.map(|(pose, size_m)| (number, pose, size_m)))
    })
}

/// Labels in the LiDAR frame of a side: all of V2X-Seq, and those of one side of DAIR-V2X. Ids are track ids if there
/// are any.
pub(super) fn in_frame(
    path: &Path,
    world_from_lidar: &Isometry3<f64>,
    block: LabelList,
) -> Result<LabelledObjects> {
    read(path, block, |number, label| {
        let dimensions = label.required("3d_dimensions")?;
        let size_m = numbers_of(&dimensions, ["l", "w", "h"])?;
        // Such labels have a box in the image alone.
        if size_m.contains(&0.0) {
            return Ok(None);
        }
        let size_m = dimensions.checked_size(size_m)?;
        let location = label.required("3d_location")?;
        let [x, y, z] = numbers_of(&location, ["x", "y", "z"])?;
        let center = Translation3::new(x, y, z);
        let rotation = label.required("rotation")?;
        let yaw_rad = box_angle_rad(rotation.number()?).map_err(|reason| rotation.error(reason))?;
        let yaw = UnitQuaternion::from_axis_angle(&Vector3::z_axis(), yaw_rad);
        let pose = poses::valid(world_from_lidar * Isometry3::from_parts(center, yaw));
        let pose = pose.map_err(|error| location.error(error.to_string()))?;
        let number = track(label).unwrap_or(number);
        Ok(Some((number, pose, size_m)))
    })
}

/// The track of an object, if it has one. A larger number would reach into the ids of another list.
fn track(label: &JsonField<'_>) -> Option<i64> {
    let track = label.optional("track_id").ok()??;
    let track = i64::try_from(track.count().ok()?).ok()?;
    (track < BLOCK - MAX_BOXES as i64).then_some(track)
}

/// Reads a list. Objects without a track are numbered from 0 on, above all tracks.
fn read(
    path: &Path,
    block: LabelList,
    labelled: impl Fn(i64, &JsonField<'_>) -> Result<Option<LabelledBox>>,
) -> Result<LabelledObjects> {
    let value = json::read(path)?;
    let root = JsonField::root(path, &value);
    let labels = root.items()?;
    if labels.len() > MAX_BOXES {
        let reason = format!("{} boxes, expected at most {MAX_BOXES}", labels.len());
        return Err(ReadError::malformed(path, reason));
    }
    let (mut objects, mut problems) = (Vec::with_capacity(labels.len()), Vec::new());
    let highest = root.items()?.filter_map(|label| track(&label)).max();
    let free = highest.map_or(0, |track| track + 1);
    for (number, label) in (free..).zip(labels) {
        let Some(found) = labelled(number, &label).transpose() else {
            continue;
        };
        match found.and_then(|found| Ok((found, label.required("type")?.text()?))) {
            Ok(((id, world_from_object, size_m), kind)) => {
                problems.extend(classes::unknown_label(path, kind));
                // An object of unknown type is not a vehicle.
                let class = classes::of_name(kind).unwrap_or(ObjectClass::Other);
                objects.push(Object::new(id, class, world_from_object, size_m));
            }
            Err(error) => problems.push(Problem::left_out("object", error)),
        }
    }
    repeats::leave_out(path, &mut objects, &mut problems);
    for object in &mut objects {
        object.id = block.id(object.id);
    }
    Ok((objects, problems))
}

fn numbers_of(field: &JsonField<'_>, keys: [&str; 3]) -> Result<[f64; 3]> {
    let [first, second, third] = keys.map(|key| field.required(key)?.number());
    Ok([first?, second?, third?])
}

/// Pose and size of a box from its corners: four of the bottom, in order around it from the front, then those above
/// them. The edge from the third and fourth corner to the second and first points ahead; the first may be on either
/// side.
#[expect(clippy::indexing_slicing, reason = "24 numbers are 8 corners")]
fn from_corners(field: &JsonField<'_>) -> Result<Option<(Pose, [f64; 3])>> {
    let numbers = field.numbers::<24>()?;
    let corners = numbers.as_chunks::<3>().0.iter();
    let corners: Vec<Vector3<f64>> = corners.map(|corner| Vector3::from(*corner)).collect();
    let parallel_edges = [
        [(0, 3), (1, 2), (4, 7), (5, 6)],
        [(0, 1), (3, 2), (4, 5), (7, 6)],
        [(4, 0), (5, 1), (6, 2), (7, 3)],
    ];
    let [ahead, aside, above] = parallel_edges.map(|pairs: [(usize, usize); 4]| {
        let edges = pairs.iter().map(|&(to, from)| corners[to] - corners[from]);
        edges.sum::<Vector3<f64>>() / 4.0
    });
    let size_m = [ahead.norm(), aside.norm(), above.norm()];
    if size_m.contains(&0.0) {
        return Ok(None);
    }
    let size_m = field.checked_size(size_m)?;
    let skew = [(ahead, aside), (aside, above), (above, ahead)]
        .map(|(a, b)| (a.normalize().dot(&b.normalize())).abs());
    if !skew.iter().all(|cosine| *cosine <= MAX_SKEW) {
        return Err(field.error(format!(
            "no box: cosines {skew:.2?} between its edges, expected at most {MAX_SKEW}"
        )));
    }
    let x = ahead.normalize();
    // Not from `aside`: right-handed on whichever side the first corner is.
    let y = above.cross(&x).normalize();
    let rotation = Rotation3::from_matrix_unchecked(Matrix3::from_columns(&[x, y, x.cross(&y)]));
    let center = corners.into_iter().sum::<Vector3<f64>>() / 8.0;
    let rotation = UnitQuaternion::from_rotation_matrix(&rotation);
    let pose = poses::valid(Isometry3::from_parts(center.into(), rotation));
    let pose = pose.map_err(|error| field.error(error.to_string()))?;
    Ok(Some((pose, size_m)))
}

/// Gives objects of one side the ids of the other side's that they overlap, so that objects of both merge by id.
///
/// The two sides are labelled independently. Of several candidates the one with the largest overlap is used; each id is
/// given once.
#[expect(
    clippy::indexing_slicing,
    reason = "indices of the lists that they were taken from"
)]
pub(super) fn share_ids(
    objects: &mut [Object],
    others: &[Object],
    lidar_from_world: &Isometry3<f64>,
) {
    let footprint =
        |object: &Object| Polygon::footprint(&upright_box(object, lidar_from_world).corners());
    let own: Vec<Polygon> = objects.iter().map(footprint).collect();
    let theirs: Vec<Polygon> = others.iter().map(footprint).collect();
    let mut overlaps = Vec::new();
    for (index, footprint) in own.iter().enumerate() {
        for (other, their) in theirs.iter().enumerate() {
            if footprint.overlaps_more_than(their, SAME_OBJECT_IOU) {
                overlaps.push((footprint.iou(their), index, other));
            }
        }
    }
    // Step: greedy assignment, the largest overlap first.
    overlaps.sort_by(|(a, ..), (b, ..)| b.total_cmp(a));
    let (mut is_named, mut is_given) = (vec![false; own.len()], vec![false; theirs.len()]);
    for (_, index, other) in overlaps {
        if !is_named[index] && !is_given[other] {
            objects[index].id = others[other].id;
            (is_named[index], is_given[other]) = (true, true);
        }
    }
}
