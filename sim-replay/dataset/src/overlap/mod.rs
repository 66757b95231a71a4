//! Overlap of sweeps at their stated poses: finds poses of other sweeps, other axes and other units,
//! and LiDARs that repeat a sweep.
//!
//! Walls, poles, trees and vehicles of two sweeps shortly after one another must coincide where the poses say so. For a
//! few pairs of each agent the overlap at the stated motion is compared with the best one around no motion.

mod structure;

use nalgebra::Isometry3;
use protocol::CavId;

use self::structure::{Match, Structure};
use super::{Layout, LoadOptions, Problem, Scenario};

/// Pairs of each agent whose poses are read, evenly spread.
const CANDIDATES: usize = 24;
/// Pairs of these whose sweeps are read, evenly spread; and those with the largest turn.
const SPREAD: usize = 3;
const TURNS: usize = 2;
/// Sweeps after the first of a spread pair that are tried for one whose stated motion is nearest [`JUDGED_M`], metres:
/// so far apart, a wrong scale or another drive differs by more than [`OTHER_M`]. It is used from half of that motion
/// on, where the successive sweeps have less, and within the turns that are searched, radians.
const LATER_STEPS: [usize; 7] = [2, 3, 4, 6, 9, 13, 19];
const JUDGED_M: f64 = 4.0;
const MOST_TURN_RAD: f64 = 0.15;
/// Ticks from one sweep to the next where successive ones are less than [`MOVED_M`] apart.
const SLOW_STEP: usize = 5;
const MOVED_M: f64 = 0.5;
/// Longest time between two sweeps that are compared, nanoseconds.
const SOON_NANOS: u64 = 2_000_000_000;
/// Range around no motion in which the best overlap is searched, metres: 1.5 times the stated motion, within these.
const SEARCH_M: [f64; 2] = [3.0, 8.0];
/// Overlap that is better: by this share of the structure, and this ratio.
const BETTER_BY: f32 = 0.15;
const BETTER_RATIO: f32 = 1.4;
/// Overlap that shows a motion at least.
const CLEAR: f32 = 0.4;
/// Smallest difference of two motions that counts.
const OTHER_M: f32 = 0.4;
const OTHER_RAD: f32 = 0.035;
/// Sweeps up to this far apart by their poses, metres, have much of their structure in common.
const NEAR_M: f64 = 3.0;
/// Share of the structure that sweeps of one place have in common at least.
const LEAST_OVERLAP: f32 = 0.2;
/// Share of the stated motion below which the best one may be that of vehicles moving as the sensor does.
const ALONGSIDE: f64 = 0.4;
/// The same overlap for sweeps that are farther apart than the search reaches.
const FAR_OVERLAP: f32 = 0.1;
/// Motion after which traffic and the frame of a map differ, metres, and the ticks that are tried for it.
const FAR_M: f64 = 6.0;
const FAR_STEPS: [usize; 5] = [1, 2, 4, 8, 16];
/// Ratio of the overlap at rest to that at the stated motion after it: a tunnel looks alike at both.
const RESTING_RATIO: f32 = 2.0;
/// Overlap at the stated motion of what does not rest: static structure among traffic has 0.65 and more, sweeps in the
/// frame of a map have 0.37 at most.
const EXPLAINED: f32 = 0.4;
/// Overlap from which two sweeps are one: traffic is never all of the structure.
const REPEATED: f32 = 0.98;

/// Two sweeps of an agent, by their ticks.
#[derive(Debug, Clone, Copy)]
struct SweepPair {
    ticks: [usize; 2],
    /// Motion by the poses: `first_from_second`.
    stated: Isometry3<f64>,
    /// True for a pair whose first sweep is that of a nearer pair, too.
    is_farther: bool,
}

/// A pair whose poses the sweeps contradict.
struct Contradiction {
    pair: SweepPair,
    /// Overlap at the stated motion.
    overlap: f32,
    best: Match,
    /// True if the structure rests however far the poses move.
    is_resting: bool,
}

/// One problem for each agent of a scenario whose sweeps contradict its poses. Reads 21 sweeps of each agent at most.
/// Agents that stand, sweeps without structure and unreadable frames give none, nor do the independent frames of KITTI
/// object.
pub fn pose_problems(scenario: &Scenario) -> Vec<Problem> {
    if scenario.layout == Layout::KITTI_OBJECT {
        return Vec::new();
    }
    let agents = scenario.agents.iter().enumerate();
    agents
        .filter_map(|(index, agent)| agent_problem(scenario, index, agent))
        .collect()
}

fn agent_problem(scenario: &Scenario, index: usize, agent: &CavId) -> Option<Problem> {
    let pairs = pairs(scenario, index).into_iter();
    let judged = pairs.filter_map(|pair| Some((pair, judge(scenario, index, pair)?)));
    let judged: Vec<(SweepPair, Option<Contradiction>)> = judged.collect();
    let count = judged.len();
    let near = judged.iter().filter(|(pair, _)| !pair.is_farther).count();
    let wrong = judged.into_iter().filter_map(|(_, wrong)| wrong);
    let mut wrong: Vec<Contradiction> = wrong.collect();
    // All sweeps in the frame of a map rest; dense traffic hides what does not in some.
    let resting = wrong.iter().filter(|one| one.is_resting).count();
    wrong.retain(|one| !one.is_resting || 2 * resting > near);
    let first = wrong.first()?;
    // One pair of several may be an object that fills the view.
    if wrong.len() < 2 && count > 1 {
        return None;
    }
    let path = scenario
        .points_path(index, first.pair.ticks[0], None)
        .ok()?;
    let path = path.parent().unwrap_or(&path).display().to_string();
    let [from, to] = first.pair.ticks.map(|tick| scenario.stem(tick));
    let reason = format!(
        "agent {agent}: {} of {count} pairs of sweeps contradict the poses: from {from} to {to} the poses have {} \
         ({:.0} % of the structure overlap), the sweeps {} ({:.0} %): poses of other sweeps, other axes or other units, \
         sweeps in the frame of a map, or a LiDAR that repeats a sweep",
        wrong.len(),
        shown(&first.pair.stated.cast()),
        100.0 * first.overlap,
        shown(&first.best.first_from_second),
        100.0 * first.best.overlap,
    );
    Some(Problem::about(&path, "world_from_lidar", &reason))
}

fn shown(motion: &Isometry3<f32>) -> String {
    let [x, y, z] = motion.translation.vector.into();
    let degrees = motion.rotation.angle().to_degrees();
    format!("({x:.1}, {y:.1}, {z:.1}) m and a turn by {degrees:.1} degrees")
}

/// Pairs that are spread evenly, near and farther apart, and those that turn most.
fn pairs(scenario: &Scenario, agent: usize) -> Vec<SweepPair> {
    let ticks: Vec<usize> = (0..scenario.ticks.len())
        .filter(|&tick| scenario.is_present(agent, tick))
        .collect();
    let step = ticks.len().div_ceil(CANDIDATES).max(1);
    let mut candidates: Vec<SweepPair> = (0..ticks.len())
        .step_by(step)
        .filter_map(|first| pair(scenario, agent, &ticks, first))
        .collect();
    // Step: pairs spread evenly over the drive, from the middle of each part.
    let step = candidates.len().div_ceil(SPREAD).max(1);
    let spread = candidates.iter().skip(step / 2).step_by(step);
    let mut chosen: Vec<SweepPair> = spread.copied().collect();
    // Step: of the others, those with the largest turn.
    candidates.retain(|pair| chosen.iter().all(|known| known.ticks != pair.ticks));
    candidates.sort_by(|a, b| {
        let [a, b] = [a, b].map(|pair| pair.stated.rotation.angle());
        b.total_cmp(&a)
    });
    let farther = chosen.iter();
    let farther = farther.filter_map(|near| farther_pair(scenario, agent, &ticks, near));
    let farther: Vec<SweepPair> = farther.collect();
    chosen.extend(candidates.into_iter().take(TURNS).chain(farther));
    chosen
}

/// The first sweep of a pair and a later one, if the poses are farther apart there.
fn farther_pair(
    scenario: &Scenario,
    agent: usize,
    ticks: &[usize],
    near: &SweepPair,
) -> Option<SweepPair> {
    let moved_m = |pair: &SweepPair| pair.stated.translation.vector.norm();
    let from_best = |pair: &SweepPair| (moved_m(pair) - JUDGED_M).abs();
    let start = near.ticks[0];
    if moved_m(near) >= JUDGED_M / 2.0 {
        // A fast drive is judged by successive sweeps.
        return None;
    }
    let place = ticks.binary_search(&start).ok()?;
    let later = LATER_STEPS.iter();
    let later = later.filter_map(|step| ticks.get(place + step));
    let pairs = later.filter_map(|later| pair_of(scenario, agent, [start, *later]));
    let pairs = pairs.filter(|pair| {
        moved_m(pair) >= JUDGED_M / 2.0 && pair.stated.rotation.angle() < MOST_TURN_RAD
    });
    let best = pairs.min_by(|a, b| from_best(a).total_cmp(&from_best(b)));
    best.map(|best| SweepPair {
        is_farther: true,
        ..best
    })
}

/// A sweep and its successor, or a later one where that is close.
fn pair(scenario: &Scenario, agent: usize, ticks: &[usize], first: usize) -> Option<SweepPair> {
    let successive = [*ticks.get(first)?, *ticks.get(first + 1)?];
    let next = pair_of(scenario, agent, successive)?;
    if next.stated.translation.vector.norm() > MOVED_M {
        return Some(next);
    }
    let later = ticks.get(first + SLOW_STEP);
    let later = later.and_then(|later| pair_of(scenario, agent, [next.ticks[0], *later]));
    Some(later.unwrap_or(next))
}

fn pair_of(scenario: &Scenario, agent: usize, ticks: [usize; 2]) -> Option<SweepPair> {
    let blind = LoadOptions::without_points();
    let [start, end] = ticks.map(|tick| scenario.ticks.get(tick).map(|tick| tick.capture_nanos));
    if end?.abs_diff(start?) > SOON_NANOS {
        return None;
    }
    let [world_from_first, world_from_second] = ticks.map(|tick| {
        let frame = scenario.load(agent, tick, &blind).ok()?;
        Some(frame.world_from_lidar?.isometry())
    });
    Some(SweepPair {
        ticks,
        stated: world_from_first?.inv_mul(&world_from_second?),
        is_farther: false,
    })
}

/// `None` if the pair cannot be judged; `Some(None)` if the sweeps agree with the poses.
#[expect(clippy::cast_possible_truncation, reason = "a radius of some metres")]
fn judge(scenario: &Scenario, agent: usize, pair: SweepPair) -> Option<Option<Contradiction>> {
    let [first, second] = (pair.ticks).map(|tick| scenario.load_points(agent, tick, None));
    let (first, second) = (first.ok()?.points, second.ok()?.points);
    let moved_m = pair.stated.translation.vector.norm();
    let is_repeated = moved_m > MOVED_M && first == second;
    let (first, second) = (Structure::of(&first)?, Structure::of(&second)?);
    let overlap = first.overlap(&second, &pair.stated.cast());
    let radius_m = (1.5 * moved_m).clamp(SEARCH_M[0], SEARCH_M[1]);
    let best = first.best_overlap(&second, radius_m as f32);
    let between = best.first_from_second.inv_mul(&pair.stated.cast());
    let is_other =
        between.translation.vector.norm() > OTHER_M || between.rotation.angle() > OTHER_RAD;
    let is_better = best.overlap > CLEAR.max(BETTER_RATIO * overlap).max(overlap + BETTER_BY);
    // The search does not reach a long motion: sweeps this far apart look alike at a wrong motion, too.
    let is_judged = moved_m <= SEARCH_M[1] || overlap < FAR_OVERLAP;
    // Vehicles that move as the sensor does suggest no motion; static structure still overlaps at the stated motion, if
    // that is not too long.
    let best_m = f64::from(best.first_from_second.translation.vector.norm());
    let is_along = best_m < ALONGSIDE * moved_m;
    let is_explained = pair.is_farther || overlap >= LEAST_OVERLAP;
    let is_traffic = is_along && is_explained && best.overlap < REPEATED;
    // No motion overlaps, although the poses are close: the sweeps are of two places.
    let is_elsewhere = moved_m < NEAR_M && overlap.max(best.overlap) < LEAST_OVERLAP;
    let is_wrong =
        is_repeated || (is_better && is_other && is_judged && !is_traffic) || is_elsewhere;
    if !is_wrong && is_along && !pair.is_farther {
        return Some(at_rest(scenario, agent, pair.ticks[0], &first));
    }
    Some(is_wrong.then_some(Contradiction {
        pair,
        overlap,
        best,
        is_resting: false,
    }))
}

/// The contradiction that the structure of the sweep of a tick stays at rest however far the poses move: the sweeps are
/// in the frame of a map.
fn at_rest(
    scenario: &Scenario,
    agent: usize,
    start: usize,
    first: &Structure,
) -> Option<Contradiction> {
    let pair = FAR_STEPS.iter().find_map(|step| {
        let pair = pair_of(scenario, agent, [start, start + step])?;
        (pair.stated.translation.vector.norm() > FAR_M).then_some(pair)
    })?;
    let second = scenario.load_points(agent, pair.ticks[1], None).ok()?;
    let (second, stated) = (Structure::of(&second.points)?, pair.stated.cast());
    let overlap = first.overlap(&second, &stated);
    let best = first.at_rest(&second);
    let is_resting = best.overlap > CLEAR.max(RESTING_RATIO * overlap)
        && first.overlap_of_rest(&second, &stated) < EXPLAINED;
    is_resting.then_some(Contradiction {
        pair,
        overlap,
        best,
        is_resting,
    })
}

#[cfg(test)]
mod tests;
