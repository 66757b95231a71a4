//! Plausibility of annotated boxes as a whole: boxes in wrong frames or units can be valid one by one.

use std::collections::BTreeSet;

use protocol::{CavId, PointCloud, Pose};

use super::cells::PointCells;
use super::lists::{FramesOfTicks, distance_m};
use crate::frame::{Frame, Object, ObjectClass};
use crate::ground_truth::{self, GroundTruthRule};
use crate::{Problem, Scenario};

/// Least number of boxes of an agent for which shares are evaluated.
const ENOUGH_BOXES: usize = 20;
/// Largest share of boxes without any of the agent's own points, of those in frames with points.
const MAX_EMPTY_SHARE: f64 = 0.5;
/// Signs of x and y of the points that are tried, and the axes that they negate.
const SIGNS: [[f32; 2]; 3] = [[1.0, 1.0], [1.0, -1.0], [-1.0, 1.0]];
const NEGATED: [&str; 3] = ["no axis", "y", "x"];
/// Least ratio of empty boxes to those that stay empty once an axis is negated. Ground lies in some boxes by chance.
const LEAST_EMPTY_RATIO: usize = 3;
/// Narrowest footprint of a car, metres. Lists without types call persons and bicycles cars, too.
const NARROWEST_CAR_M: f64 = 1.2;
/// Least length of a car, relative to its width and height, with room for errors of sizes.
const LEAST_LENGTH: f64 = 0.9;
/// Ratio of height to width above which a vehicle of at most this length, metres, is no car. Vans labelled as cars are
/// longer, or few.
const HIGHEST: f64 = 1.15;
const SHORT_M: f64 = 5.2;
/// Least number of different vehicles for it: one van may be alone in all frames.
const SEVERAL: usize = 8;
/// Length and width above which a vehicle is no car, metres. Buses and trucks are as long, but not as wide.
const LONG_M: f64 = 7.0;
const WIDE_M: f64 = 3.2;
/// Largest distance of an agent's box from that of the same vehicle in a cooperative list, metres: half a car's length
/// is more.
const SAME_VEHICLE_M: f64 = 1.5;
/// Vehicles that an agent lists for each one that the cooperative list has, too, at most: it holds nearly all of them,
/// except those far from the ego.
const MOST_PER_COMMON: usize = 3;
const HINT: &str = "frames (axes, order of the pose's numbers) or units of the boxes may be wrong";

/// The finding that agents list objects of the rule's classes, and none is ground truth of any ego. Without poses it
/// would be a consequence.
pub(super) fn without_ground_truth(
    scenario: &Scenario,
    ticks: &FramesOfTicks<'_>,
    rule: &GroundTruthRule,
) -> Option<Problem> {
    let frames = || ticks.values().flatten();
    let objects = frames().flat_map(|frame| &frame.objects);
    let targets = objects.filter(|object| rule.classes.contains(object.class));
    let (targets, read, all) = (targets.count(), ticks.len(), scenario.ticks.len());
    let is_found = |frames: &Vec<&Frame>| {
        (0..frames.len()).any(|ego| !ground_truth::merged_objects(frames, ego, rule).is_empty())
    };
    // A few objects of some of the ticks may well be out of range.
    if targets <= ENOUGH_BOXES * usize::from(read < all)
        || frames().any(|frame| is_without_pose(frame))
        || ticks.values().any(is_found)
    {
        return None;
    }
    let reason = format!(
        "ground truth 0 for every ego in {read} of {all} ticks, though agents list {targets} objects of its classes: \
         {HINT}"
    );
    Some(Problem::about(&scenario.name, "ground truth", &reason))
}

/// The finding that the cooperative lists hold hardly any of the vehicles that an agent lists itself.
pub(super) fn unlike_cooperative(
    scenario: &str,
    agent: &CavId,
    ticks: &FramesOfTicks<'_>,
) -> Option<Problem> {
    let (mut own, mut common) = (0, 0);
    for frames in ticks.values() {
        let list = (frames.iter()).find_map(|frame| frame.cooperative_objects.as_ref());
        let frame = frames.iter().find(|frame| frame.cav == *agent);
        let Some((list, frame)) = list.zip(frame) else {
            continue;
        };
        let vehicles = frame.objects.iter();
        for vehicle in vehicles.filter(|object| ObjectClass::VEHICLES.contains(&object.class)) {
            let mut others = list.iter();
            own += 1;
            common += usize::from(others.any(|other| distance_m(vehicle, other) < SAME_VEHICLE_M));
        }
    }
    let reason = format!(
        "agent {agent}: {common} of {own} vehicles that it lists are within {SAME_VEHICLE_M} m of one in the \
         cooperative labels: these are of other frames or another world, or the agent's pose is wrong"
    );
    (own >= ENOUGH_BOXES.max(MOST_PER_COMMON * common))
        .then(|| Problem::about(scenario, "cooperative labels", &reason))
}

/// True if there are objects whose place relative to the LiDAR is unknown.
pub(super) fn is_without_pose(frame: &Frame) -> bool {
    !frame.objects.is_empty() && frame.world_from_lidar.is_none()
}

/// The finding that most of the cars that an agent lists do not have the form of cars.
pub(super) fn unlike_cars<'a>(
    scenario: &str,
    agent: &CavId,
    objects: impl Iterator<Item = &'a Object>,
) -> Option<Problem> {
    let cars = objects.filter(|object| object.class == ObjectClass::Car);
    let (ids, sizes): (BTreeSet<i64>, Vec<[f64; 3]>) = (cars.map(|car| (car.id, car.size_m)))
        .filter(|(_, [length, width, _])| length.min(*width) >= NARROWEST_CAR_M)
        .unzip();
    let are_several = ids.len() >= SEVERAL;
    let wrong = (sizes.iter()).filter_map(|size| Some((size, form_fault(*size, are_several)?)));
    let ([length, width, height], fault) = wrong.clone().next()?;
    let (count, all) = (wrong.count(), sizes.len());
    let reason = format!(
        "agent {agent}: {count} of {all} cars, first of {length:.1} x {width:.1} x {height:.1} m, are {fault} may be \
         wrong"
    );
    (all >= ENOUGH_BOXES && 2 * count > all).then(|| Problem::about(scenario, "size", &reason))
}

/// The fault of a car's length, width and height, metres; it may be one of several.
fn form_fault([length, width, height]: [f64; 3], are_several: bool) -> Option<&'static str> {
    if length < LEAST_LENGTH * width.max(height) {
        return Some("shorter than wide or high: the order of the sizes");
    }
    if are_several && length < SHORT_M && height > HIGHEST * width {
        return Some("higher than wide: the order of the sizes");
    }
    (length > LONG_M && width > WIDE_M)
        .then_some("larger than any car: half or whole sizes, or their unit,")
}

/// Numbers of boxes of frames with points and a pose that hold none of the agent's points, for each of [`SIGNS`].
pub(super) type EmptyBoxes = [usize; SIGNS.len()];

/// The finding that most of the `boxes` of an agent are empty, or that these are few once an axis of the points is
/// negated.
pub(super) fn empty(
    scenario: &str,
    agent: &CavId,
    (boxes, empty): (usize, EmptyBoxes),
) -> Option<Problem> {
    let counts = NEGATED.into_iter().zip(empty);
    let (axis, least) = counts.min_by_key(|(_, empty)| *empty)?;
    let [empty, ..] = empty;
    if empty >= ENOUGH_BOXES + least && empty >= LEAST_EMPTY_RATIO * least {
        let reason = format!(
            "agent {agent}: {empty} of {boxes} boxes hold none of its points, but only {least} once {axis} of the \
             points is negated: points or boxes may be mirrored"
        );
        return Some(Problem::about(scenario, "boxes", &reason));
    }
    let share = empty as f64 / boxes.max(1) as f64;
    let reason = format!(
        "agent {agent}: {empty} of {boxes} boxes ({:.0} %) hold none of its points: {HINT}",
        100.0 * share
    );
    (boxes >= ENOUGH_BOXES && share > MAX_EMPTY_SHARE)
        .then(|| Problem::about(scenario, "boxes", &reason))
}

/// Numbers of boxes of a frame that hold none of the points; `pose` is that of the LiDAR.
pub(super) fn without_points(frame: &Frame, pose: &Pose, points: &PointCloud) -> EmptyBoxes {
    let (cells, world_from_lidar) = (PointCells::new(points), pose.isometry());
    SIGNS.map(|signs| {
        let empty = frame.objects.iter().filter(|object| {
            let world_from_object = object.world_from_object.isometry();
            let object_from_lidar = world_from_object.inv_mul(&world_from_lidar);
            #[expect(clippy::cast_possible_truncation, reason = "rounded to f32")]
            let half = object.size_m.map(|size| (size / 2.0) as f32);
            let object_from_lidar = object_from_lidar.cast();
            let held = cells.points_in(&object_from_lidar, half, signs).next();
            held.is_none()
        });
        empty.count()
    })
}
