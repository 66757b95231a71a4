//! Fit of boxes to points: turned boxes, wrong sizes and the list of another frame hold fewer of the points near them.
//! Compares each list with trials of it on the same points, so that no sensor and no scene needs a threshold of its own.

use std::collections::BTreeMap;
use std::f64::consts::FRAC_PI_2;

use protocol::{CavId, Pose};
use rayon::prelude::*;

use super::cells::PointCells;
use crate::frame::{Frame, Object, ObjectClass};
use crate::{LoadOptions, Problem, Scenario};
use support::sampling::evenly_spread;
use support::statistics;

/// Frames of each agent that are read, and the one before and after each.
const FRAMES: usize = 10;
/// Least longer side of a vehicle, metres: persons and bicycles are too narrow to tell.
const LEAST_LENGTH_M: f64 = 2.0;
/// Reach around a box in the plane in which points count as near, metres.
const NEAR_M: f64 = 1.0;
/// Margin of a box in the plane, metres: points lie on its surface.
const MARGIN_M: f64 = 0.1;
/// Height above the floor of a box up to which points are of the ground, metres.
const GROUND_M: f64 = 0.3;
/// Height above the top of a box up to which points count, metres.
const ABOVE_M: f64 = 0.2;
/// Least number of points near a box for its share.
const ENOUGH_POINTS: usize = 20;
/// Least number of boxes for which shares are compared.
const ENOUGH_BOXES: usize = 20;
/// The same for judging the share of the labels alone.
const MANY_BOXES: usize = 40;
/// Two boxes are one if centres and ends are nearer than this, metres.
const SAME_M: f64 = 0.5;
/// Ages of the points of an object, seconds: a LiDAR turns in up to a tenth of a second, and the object drives on until
/// the sweep ends, to which its box belongs. The age at which the box holds most points counts.
const AGES_S: [f64; 5] = [0.0, 0.025, 0.05, 0.075, 0.1];
/// Share by which a better trial holds more than the labels, in the mean and in the median.
const BETTER_BY: f64 = 0.15;
/// Share of a trial from which it may be what the labels should be: those that mend a fault hold 0.83 and more.
const SOUND_SHARE: f64 = 0.7;
/// Share that labels hold at least: those of sound scenes hold 0.9, boxes of quite another frame 0.4.
const LEAST_SHARE: f64 = 0.45;
/// A change of a box: multiples of its heading and its bearing, both seen from the LiDAR, of the LiDAR's heading in the
/// world, and of a right angle, which sum up to the new heading; a scale; a motion along x and y of the LiDAR, metres.
type Change = [f64; 7];
const TRIALS: [(&str, Change); 11] = [
    ("turned by 90 degrees", [1.0, 0.0, 0.0, 1.0, 1.0, 0.0, 0.0]),
    ("of negated heading", [-1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0]),
    ("negated in world", [-1.0, 0.0, -2.0, 0.0, 1.0, 0.0, 0.0]),
    ("negated and turned", [-1.0, 0.0, 0.0, 1.0, 1.0, 0.0, 0.0]),
    ("turned by the bearing", [1.0, 1.0, 0.0, 0.0, 1.0, 0.0, 0.0]),
    ("twice as large", [1.0, 0.0, 0.0, 0.0, 2.0, 0.0, 0.0]),
    ("half as large", [1.0, 0.0, 0.0, 0.0, 0.5, 0.0, 0.0]),
    ("1.2 m ahead", [1.0, 0.0, 0.0, 0.0, 1.0, 1.2, 0.0]),
    ("1.2 m behind", [1.0, 0.0, 0.0, 0.0, 1.0, -1.2, 0.0]),
    ("1.2 m to the left", [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 1.2]),
    ("1.2 m to the right", [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, -1.2]),
];
const OTHER_FRAMES: [&str; 2] = ["of the frame before", "of the frame after"];

/// A list of a frame.
type ListOf = fn(&Frame) -> &[Object];
/// The lists of a frame, by the field that a finding names.
pub(super) const LISTS: [(&str, ListOf); 2] = [
    ("boxes", |frame| &frame.objects),
    ("cooperative labels", |frame| {
        frame.cooperative_objects.as_deref().unwrap_or_default()
    }),
];

/// A box in the frame of the LiDAR.
struct PlacedBox {
    lidar_from_box: Pose,
    size_m: [f64; 3],
    /// Zero if it is not recorded.
    speed_mps: f64,
}

/// Shares of the labels and of a trial, without the boxes that are in both, by trial. Of a change they are pairs: a box
/// that it moves away from all points would count for the labels alone.
pub(super) type Comparisons = BTreeMap<&'static str, [Vec<f64>; 2]>;

/// The problem of a list of an agent that the points contradict; `field` names the list.
pub(super) fn problem(
    scenario: &Scenario,
    (index, agent): (usize, &CavId),
    (field, list): (&str, ListOf),
) -> Option<Problem> {
    let ticks = 0..scenario.ticks.len();
    let ticks = ticks.filter(|&tick| scenario.is_present(index, tick));
    let ticks = evenly_spread(&ticks.collect::<Vec<_>>(), FRAMES).into_par_iter();
    let sweeps = ticks.filter_map(|tick| of_sweep(scenario, index, tick, list));
    let mut all = Comparisons::new();
    for (name, compared) in sweeps.collect::<Vec<_>>().into_iter().flatten() {
        let sums = all.entry(name).or_default().iter_mut();
        (sums.zip(compared)).for_each(|(sum, shares)| sum.extend(shares));
    }
    let reason = format!("agent {agent}: {}", fault(&all)?);
    Some(Problem::about(&scenario.name, field, &reason))
}

/// The comparisons on one sweep. `None` without boxes or a pose.
fn of_sweep(scenario: &Scenario, agent: usize, tick: usize, list: ListOf) -> Option<Comparisons> {
    let options = LoadOptions::without_points();
    let load = |tick| scenario.load(agent, tick, &options).ok();
    let frame = load(tick)?;
    let lidar_rad = frame.world_from_lidar?.yaw_rad();
    let labels = placed(&frame, list).filter(|labels| !labels.is_empty())?;
    let cells = PointCells::new(&scenario.load_points(agent, tick, None).ok()?.points);
    let compared = |boxes: &[PlacedBox], ages_s: &[f64]| {
        let both = [(&labels[..], boxes), (boxes, &labels[..])];
        both.map(|(of, others)| shares(of, others, (&cells, ages_s)))
    };
    let trials = TRIALS.into_iter().map(|(name, change)| {
        let boxes = labels.iter().map(|one| one.changed(lidar_rad, change));
        let [own, changed] = compared(&boxes.collect::<Vec<_>>(), &AGES_S);
        let pairs = own.into_iter().zip(changed);
        let pairs = pairs.filter_map(|(own, changed)| own.zip(changed));
        let (own, changed): (Vec<f64>, Vec<f64>) = pairs.unzip();
        (name, [own, changed])
    });
    let others = [tick.checked_sub(1).and_then(load), load(tick + 1)];
    let others = OTHER_FRAMES.into_iter().zip(others);
    let others = others.filter_map(|(name, other)| {
        // The greatest ages would stand for the frame.
        let both = compared(&placed(&other?, list)?, &AGES_S[..3]);
        Some((
            name,
            both.map(|of| of.into_iter().flatten().collect::<Vec<f64>>()),
        ))
    });
    Some(trials.chain(others).collect())
}

/// The vehicles of a list. `None` without a pose.
fn placed(frame: &Frame, list: ListOf) -> Option<Vec<PlacedBox>> {
    let lidar = frame.world_from_lidar?;
    let vehicles = list(frame).iter();
    let vehicles = vehicles.filter(|object| ObjectClass::VEHICLES.contains(&object.class));
    let boxes = vehicles.map(|object| PlacedBox {
        lidar_from_box: lidar.from_world(&object.world_from_object),
        size_m: object.size_m,
        speed_mps: object.speed_mps.unwrap_or(0.0),
    });
    Some(boxes.collect())
}

/// The share of each box, at the age at which it holds most points; `None` for one that is among the others, is small, or has too few
/// points near it.
fn shares(
    boxes: &[PlacedBox],
    others: &[PlacedBox],
    (cells, ages_s): (&PointCells, &[f64]),
) -> Vec<Option<f64>> {
    let shares = boxes.iter().map(|one| {
        let is_long = one.size_m[0].max(one.size_m[1]) >= LEAST_LENGTH_M;
        if !is_long || others.iter().any(|other| one.is_same(other)) {
            return None;
        }
        let shares = ages_s.iter();
        let shares = shares.filter_map(|&age_s| one.share_inside(cells, age_s));
        let fullest = shares.max_by_key(|(inside, _)| *inside)?;
        Some(fullest.1)
    });
    shares.collect()
}

/// The fault of a list: the trial that fits best if that is clearly better, or boxes that do not fit at all.
pub(super) fn fault(comparisons: &Comparisons) -> Option<String> {
    let mean = |shares: &[f64]| statistics::mean(shares).unwrap_or(0.0);
    let median = |shares: &[f64]| statistics::median(shares).unwrap_or(0.0);
    let trials = comparisons.iter();
    let trials = trials.filter(|(_, both)| both.iter().all(|of| of.len() >= ENOUGH_BOXES));
    // A fault is one of most boxes. Of fast vehicles without a recorded speed, the points are beside them in some places.
    let trials = trials.filter(|(_, [labels, trial])| median(trial) - median(labels) >= BETTER_BY);
    let trials = trials.map(|(name, [labels, trial])| (name, mean(labels), mean(trial)));
    let trials = trials.filter(|(_, _, trial)| *trial >= SOUND_SHARE);
    let best = trials.max_by(|one, other| (one.2 - one.1).total_cmp(&(other.2 - other.1)));
    if let Some((name, labels, trial)) = best.filter(|best| best.2 - best.1 >= BETTER_BY) {
        return Some(format!(
            "the points fit boxes {name} better: {trial:.2} of the structure near them is inside, {labels:.2} as the \
             labels are"
        ));
    }
    // Boxes twice as large are all others, and hold the same points: that trial has all labels.
    let all = comparisons.values().map(|[labels, _]| labels);
    let all = all.max_by_key(|labels| labels.len())?;
    let (count, share) = (all.len(), mean(all));
    (count >= MANY_BOXES && share < LEAST_SHARE).then(|| {
        format!(
            "{share:.2} of the structure near {count} boxes is inside, expected {LEAST_SHARE} at least: boxes, poses \
             or points are of other frames or places"
        )
    })
}

impl PlacedBox {
    /// The box once changed; the heading is that of the LiDAR in the world, radians.
    fn changed(&self, lidar_rad: f64, change: Change) -> Self {
        let [own, sight, lidar, right, scale, dx, dy] = change;
        let [x, y, z] = self.lidar_from_box.translation_m;
        let heading_rad = own * self.lidar_from_box.yaw_rad() + sight * y.atan2(x);
        let heading_rad = heading_rad + lidar * lidar_rad + right * FRAC_PI_2;
        Self {
            lidar_from_box: Pose::from_xyz_yaw([x + dx, y + dy, z], heading_rad),
            size_m: self.size_m.map(|size| scale * size),
            speed_mps: self.speed_mps,
        }
    }

    /// True if the other box is in the same place. Front and back may be exchanged.
    fn is_same(&self, other: &Self) -> bool {
        let ([length, ..], [other_length, ..]) = (self.size_m, other.size_m);
        let [one, other] = [self, other].map(|placed| placed.lidar_from_box);
        let turned_m = length / 2.0 * (one.yaw_rad() - other.yaw_rad()).sin().abs();
        let longer_m = (length - other_length).abs() / 2.0;
        one.planar_distance_m(&other).max(turned_m).max(longer_m) < SAME_M
    }

    /// Number of points above the ground in the box, at its place some time before, and their share of those in it or near
    /// it, if they are enough.
    fn share_inside(&self, cells: &PointCells, age_s: f64) -> Option<(usize, f64)> {
        let [length, width, height] = self.size_m.map(|size| size / 2.0);
        let reach = [length + NEAR_M, width + NEAR_M, height + ABOVE_M];
        #[expect(clippy::cast_possible_truncation, reason = "rounded to f32")]
        let reach = reach.map(|metres| metres as f32);
        let travelled = Pose::from_xyz_yaw([-age_s * self.speed_mps, 0.0, 0.0], 0.0);
        let lidar_from_box = self.lidar_from_box.isometry() * travelled.isometry();
        let box_from_lidar = lidar_from_box.inverse().cast();
        let (mut near, mut inside) = (0_usize, 0_usize);
        for point in cells.points_in(&box_from_lidar, reach, [1.0; 2]) {
            let [x, y, z] = [point.x, point.y, point.z].map(f64::from);
            let is_in = x.abs() <= length + MARGIN_M && y.abs() <= width + MARGIN_M;
            near += usize::from(z >= GROUND_M - height);
            inside += usize::from(z >= GROUND_M - height && is_in);
        }
        (near >= ENOUGH_POINTS).then(|| (inside, inside as f64 / near as f64))
    }
}
