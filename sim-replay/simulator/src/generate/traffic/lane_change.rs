//! Lane changes: incentive, gain and safety criterion of MOBIL (Kesting, Treiber and Helbing 2007).

use super::car::{Car, LaneChangeState, Side};
use super::driver::Obstacle;
use super::path::{Beside, Path};
use super::rectangle::Rectangle;
use super::roads::Roads;
use super::{STEP_S, Traffic};
use crate::map::LaneId;

/// Duration of a change at an even speed, seconds.
const CHANGE_S: f64 = 4.5;
/// Shortest distance over which a change is driven, metres.
const CHANGE_LEAST_M: f64 = 22.0;
/// Lowest speed at which a change begins, metres per second.
const LEAST_SPEED_MPS: f64 = 2.5;
/// Time behind a slower vehicle after which a driver wants to overtake, seconds.
const FOLLOWING_S: f64 = 3.0;
/// After a change the time behind a slower vehicle starts this much below zero, seconds.
const REST_S: f64 = 8.0;
/// A vehicle ahead is slower if it drives less than this share of the driver's desired speed.
const SLOW_SHARE: f64 = 0.8;
/// A change must gain at least this much acceleration, metres per second squared.
const GAIN_MPS2: f64 = 0.3;
/// Strongest braking that a change may impose on others, metres per second squared.
const SAFE_MPS2: f64 = 2.0;
/// Least gap before and behind on the new lane, metres.
const SAFE_GAP_M: f64 = 2.5;
/// Followers on the new lane are searched this far behind, metres.
const BEHIND_M: f64 = 60.0;
/// Duration for which a random wish to change is kept, seconds.
const RANDOM_CHANGE_S: f64 = 8.0;
/// Probability of a random change of an exploring focus where neither lane is better.
const RANDOM_CHANGE_SHARE: f64 = 0.25;
/// Neighbours whose lengths differ by more than this share lie in a bend too tight for a change.
const LENGTH_SHARE: f64 = 0.04;
/// Narrower lanes are not changed to, metres.
const LEAST_WIDTH_M: f64 = 2.6;

impl Traffic<'_> {
    /// Begins the changes that are wanted, possible and safe. Needs the list of occupants, and keeps it up to date.
    pub(super) fn change_lanes(&mut self, near: &mut Vec<u32>) {
        for index in self.present() {
            self.update_state(index);
            if let Some(path) = self.wanted_change(index, near) {
                self.begin_change(index, path);
            }
        }
    }

    fn update_state(&mut self, index: usize) {
        let car = &mut self.cars[index];
        let is_held_up = is_held_up(car, self.roads);
        let state = &mut car.lane_change;
        // The waiting time after a change elapses in any case.
        state.held_up_s = match is_held_up || state.held_up_s < 0.0 {
            true => state.held_up_s + STEP_S,
            false => (state.held_up_s - STEP_S).max(0.0),
        };
        state.random_change_timer_s -= STEP_S;
        if state.random_change_timer_s > 0.0 {
            return;
        }
        // A random change expires; after the pause there may be another one.
        let random_change = match state.random_change {
            Some(_) => None,
            None => self.random_change(index),
        };
        let turns_in_s = match random_change {
            Some(_) => RANDOM_CHANGE_S,
            None => self.time_to_random_change_s(index),
        };
        let state = &mut self.cars[index].lane_change;
        (state.random_change, state.random_change_timer_s) = (random_change, turns_in_s);
    }

    fn time_to_random_change_s(&mut self, index: usize) -> f64 {
        match index == 0 && self.options.focus_explores {
            true => self.random.between(4.0, 16.0),
            false => self.random.between(20.0, 80.0),
        }
    }

    /// Side of a random change; for an exploring focus, one that leads to less visited roads.
    fn random_change(&mut self, index: usize) -> Option<Side> {
        let own = self.cars[index].path.lane();
        let lane = self.roads.graph.lane(own);
        let sides = [Side::Left, Side::Right].into_iter();
        let sides = sides.filter_map(|side| Some((side, side.of(lane)?)));
        let mut sides: Vec<(Side, LaneId)> = sides.collect();
        if let Some(explorer) = self.explorer.as_mut().filter(|_| index == 0) {
            let mut better = sides.clone();
            better.retain(|&(_, lane)| explorer.prefers(lane, own));
            if better.is_empty() && !self.random.chance(RANDOM_CHANGE_SHARE) {
                return None;
            }
            if !better.is_empty() {
                sides = better;
            }
        }
        Some(sides.get(self.random.below(sides.len()))?.0)
    }

    /// The path after a change that may begin now.
    fn wanted_change(&self, index: usize, near: &mut Vec<u32>) -> Option<Path> {
        let car = &self.cars[index];
        if car.path.is_changing() || car.speed_mps < LEAST_SPEED_MPS {
            return None;
        }
        let own = car.path.lane();
        let is_held_up = car.lane_change.held_up_s > FOLLOWING_S;
        [Side::Left, Side::Right].into_iter().find_map(|side| {
            let other = side.of(self.roads.graph.lane(own))?;
            let must_leave = !self.roads.is_endless(own) && self.roads.is_endless(other);
            let is_random = car.lane_change.random_change == Some(side);
            if !must_leave && !is_held_up && !is_random {
                return None;
            }
            let path = path_beside(car, side, self.roads)?;
            // Only overtaking must pay off; a lane that ends has to be left.
            let is_worth = must_leave || !is_held_up || self.gain_mps2(index, &path) > GAIN_MPS2;
            (is_worth && self.is_safe(index, &path, near)).then_some(path)
        })
    }

    /// Gain in acceleration on another path, metres per second squared.
    fn gain_mps2(&self, index: usize, path: &Path) -> f64 {
        let car = &self.cars[index];
        let wanted_mps = free_speed_mps(car, self.roads);
        // The leader of the last step: those of this step are found after the changes.
        let [changed, kept] = [self.leader_on(index, path), car.leader].map(|leader| {
            car.driver
                .acceleration_mps2(car.speed_mps, wanted_mps, leader.as_slice())
        });
        changed - kept
    }

    /// True if a change is safe: the driver's own path past the vehicle ahead, and the gaps on the new lane.
    fn is_safe(&self, index: usize, path: &Path, near: &mut Vec<u32>) -> bool {
        let car = &self.cars[index];
        if !car.leader.is_none_or(|leader| {
            // Halfway the vehicle is past the one ahead, which moves on in the meantime.
            let closing_share = (1.0 - leader.speed_mps / car.speed_mps).max(0.0);
            leader.gap_m > 0.55 * change_m(car) * closing_share + SAFE_GAP_M
        }) {
            return false;
        }
        let leader = self.leader_on(index, path);
        if !leader.is_none_or(|leader| brakes_softly(car, leader)) {
            return false;
        }
        let follower = self.follower_on(index, path.lane(), path.s_m);
        if !follower.is_none_or(|(follower, apart_m)| {
            let follower = &self.cars[follower];
            let gap_m = apart_m - car.half_length_m() - follower.half_length_m();
            let speed_mps = car.speed_mps;
            brakes_softly(follower, Obstacle { gap_m, speed_mps })
        }) {
            return false;
        }
        // Vehicles that are not in the list of the lane: those that cross it, or have nearly left it.
        let beside = Path::new(path.lane(), path.s_m);
        let graph = self.roads.graph;
        let beside = beside.placement(graph, 0.0, car.wheelbase_m(), car.aside_m);
        let mut room = Rectangle::new(&beside, &car.vehicle.size_m).grown(0.3);
        room.half_m[0] += SAFE_GAP_M;
        self.is_free(index, &room, near)
    }

    /// The next follower behind a position on a lane, and the distance between the centres, metres.
    fn follower_on(&self, index: usize, lane: LaneId, s_m: f64) -> Option<(usize, f64)> {
        let mut nearest: Option<(usize, f64)> = None;
        // Lanes still to be searched, and the distance of their ends behind the position.
        let graph = self.roads.graph;
        let mut open = vec![(lane, s_m - graph.lane(lane).length_m)];
        while let Some((lane, end_m)) = open.pop() {
            let start_m = end_m + graph.lane(lane).length_m;
            let behind = self.occupants[lane.0 as usize]
                .iter()
                .map(|&(other_m, other)| (other as usize, start_m - other_m))
                .filter(|&(other, apart_m)| other != index && apart_m >= 0.0)
                .min_by(|a, b| a.1.total_cmp(&b.1));
            match behind {
                Some(found) if nearest.is_none_or(|least| found.1 < least.1) => {
                    nearest = Some(found);
                }
                None if start_m < BEHIND_M => {
                    let before = graph.lane(lane).predecessors.iter();
                    open.extend(before.map(|&before| (before, start_m)));
                }
                _ => {}
            }
        }
        nearest
    }

    fn begin_change(&mut self, index: usize, path: Path) {
        let pause_s = self.time_to_random_change_s(index);
        let car = &mut self.cars[index];
        car.lane_change = LaneChangeState {
            held_up_s: -REST_S,
            random_change: None,
            random_change_timer_s: pause_s,
        };
        if let Some(explorer) = self.explorer.as_mut().filter(|_| index == 0) {
            // Lanes that were decided but will not be driven do not count.
            let graph = self.roads.graph;
            let undone = car.path.ahead(graph).skip(1);
            undone.for_each(|(lane, _)| explorer.give_up(lane));
            let chosen = path.ahead(graph);
            chosen.for_each(|(lane, _)| explorer.choose(lane));
        }
        let entry = (path.s_m, index as u32);
        let occupants = &mut self.occupants[path.lane().0 as usize];
        let place = occupants.partition_point(|other| *other < entry);
        occupants.insert(place, entry);
        car.path = path;
    }
}

/// The desired speed here without a vehicle ahead, metres per second.
fn free_speed_mps(car: &Car, roads: &Roads<'_>) -> f64 {
    car.driver.pace * roads.speed_mps(car.path.lane(), car.path.s_m)
}

fn is_held_up(car: &Car, roads: &Roads<'_>) -> bool {
    let slow_mps = SLOW_SHARE * free_speed_mps(car, roads);
    car.leader.as_ref().is_some_and(|leader| {
        leader.speed_mps < slow_mps && leader.gap_m < 8.0 + 2.5 * car.speed_mps
    }) && car.speed_mps < slow_mps
}

/// True if a driver keeps the least gap to a vehicle ahead without strong braking.
fn brakes_softly(car: &Car, ahead: Obstacle) -> bool {
    let speed_mps = car.speed_mps;
    // With its own speed as the desired one, the free term of the model is 0 and the braking remains.
    let braking = -car.driver.acceleration_mps2(speed_mps, speed_mps, &[ahead]);
    ahead.gap_m > SAFE_GAP_M && braking < SAFE_MPS2
}

/// Length of a change, metres.
fn change_m(car: &Car) -> f64 {
    (CHANGE_S * car.speed_mps).max(CHANGE_LEAST_M)
}

/// The path beside the present one, if the two lie side by side for as long as the change takes.
fn path_beside(car: &Car, side: Side, roads: &Roads<'_>) -> Option<Path> {
    let graph = roads.graph;
    let mut under = car.path.lanes_under(graph, car.half_length_m());
    if under.any(|lane| graph.lane(lane).junction.is_some()) {
        return None;
    }
    let mut left = car.path.lane();
    let mut lane = side.of(graph.lane(left))?;
    let s_m = car.path.s_m / graph.lane(left).length_m * graph.lane(lane).length_m;
    // The curve begins at the front axle, and the front bumper is half a length ahead of the centre.
    let needed_m = change_m(car) + 0.5 * car.wheelbase_m() + car.half_length_m();
    let (mut beside, mut reach_m) = (Vec::new(), -s_m);
    loop {
        if !lies_beside(lane, left, roads) {
            return None;
        }
        beside.push(Beside { lane, left });
        reach_m += graph.lane(lane).length_m;
        if reach_m >= needed_m {
            let mut path = car.path.clone();
            path.change(beside, s_m, change_m(car), car.wheelbase_m());
            return Some(path);
        }
        (lane, left) = roads.onward(lane).into_iter().find_map(|next| {
            let next_left = side.opposite().of(graph.lane(next))?;
            let is_next = graph.lane(left).successors.contains(&next_left);
            is_next.then_some((next, next_left))
        })?;
    }
}

/// True if a vehicle may change from one neighbour to the other anywhere along them.
fn lies_beside(lane: LaneId, left: LaneId, roads: &Roads<'_>) -> bool {
    let (to, from) = (roads.graph.lane(lane), roads.graph.lane(left));
    // Never from a lane that goes on to one that ends.
    let leads_on = roads.is_endless(lane) || !roads.is_endless(left);
    let is_even = (to.length_m / from.length_m - 1.0).abs() < LENGTH_SHARE;
    let is_wide = to.widths_m.iter().all(|&width_m| width_m > LEAST_WIDTH_M);
    to.junction.is_none() && from.junction.is_none() && leads_on && is_even && is_wide
}
