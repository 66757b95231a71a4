//! Look-ahead: obstacles on the path ahead, and the acceleration that follows from them.

use super::Traffic;
use super::driver::Obstacle;
use super::path::Path;
use crate::generate::raycast::wrapped;
use crate::map::LaneId;

/// Vehicles that stand longer than this stop giving way to those beside them, seconds.
const MOST_STANDING_S: f64 = 6.0;
/// Free space required beside the swept path, metres.
const SIDE_ROOM_M: f64 = 0.25;
/// Distance between the samples along the swept path, metres.
const SWEEP_STEP_M: f64 = 1.5;
/// Distance of the stop line before the first lane of a junction, metres.
const STOP_LINE_M: f64 = 0.8;
/// Free length required after the junction beyond the vehicle's own, metres.
const EXIT_ROOM_M: f64 = 3.0;
/// A vehicle in the space behind a junction that is faster than this counts as leaving it, metres per second.
const MOVING_ON_MPS: f64 = 3.0;

impl Traffic<'_> {
    /// Acceleration of a driver now, metres per second squared.
    pub(super) fn acceleration_mps2(&mut self, index: usize, near: &mut Vec<u32>) -> f64 {
        let mut obstacles = Vec::with_capacity(4);
        let leader = self.leader_on(index, &self.cars[index].path);
        self.cars[index].leader = leader;
        obstacles.extend(leader);
        obstacles.extend(self.stop_line(index));
        obstacles.extend(self.in_own_path(index, near));
        obstacles.extend(self.end_of_the_way(index));
        let wanted = self.wanted_speed_mps(index);
        let car = &self.cars[index];
        car.driver
            .acceleration_mps2(car.speed_mps, wanted, &obstacles)
    }

    /// The speed permitted by limits and bends ahead, metres per second.
    fn wanted_speed_mps(&self, index: usize) -> f64 {
        let car = &self.cars[index];
        let braking = 0.7 * car.driver.comfort_mps2;
        let horizon_m = car.speed_mps * car.speed_mps / (2.0 * braking) + 6.0;
        let mut wanted = f64::MAX;
        for (lane, start_m) in car.path.ahead(self.roads.graph) {
            if start_m > horizon_m {
                break;
            }
            let end_m = (start_m + self.roads.graph.lane(lane).length_m).min(horizon_m);
            let mut at_m = start_m.max(0.0);
            while at_m <= end_m {
                let bend = car.driver.pace * self.roads.speed_mps(lane, at_m - start_m);
                // The speed from which comfortable braking reaches the bend's speed in time.
                wanted = wanted.min((bend * bend + 2.0 * braking * at_m).sqrt());
                at_m += 2.0;
            }
        }
        wanted
    }

    /// The next vehicle on the lanes of a path from its present position on.
    pub(super) fn leader_on(&self, index: usize, path: &Path) -> Option<Obstacle> {
        let car = &self.cars[index];
        let horizon_m = 30.0 + 3.0 * car.speed_mps;
        for (lane, start_m) in path.ahead(self.roads.graph) {
            if start_m > horizon_m {
                return None;
            }
            // Vehicles at the same position are ordered by index, as in the list.
            let mut occupants = self.occupants[lane.0 as usize].iter();
            let ahead = occupants.find(|&&(s_m, other)| {
                other as usize != index && (start_m + s_m, other as usize) > (0.0, index)
            });
            if let Some(&(s_m, other)) = ahead {
                let leader = &self.cars[other as usize];
                let gap_m = start_m + s_m - car.half_length_m() - leader.half_length_m();
                let speed_mps = leader.speed_mps;
                return Some(Obstacle { gap_m, speed_mps });
            }
        }
        None
    }

    /// The line before the next junction lane that may not be entered.
    fn stop_line(&mut self, index: usize) -> Option<Obstacle> {
        let car = &self.cars[index];
        let horizon_m = car.half_length_m() + car.speed_mps * car.speed_mps / (2.0 * 1.8) + 6.0;
        let graph = self.roads.graph;
        let ahead: Vec<(LaneId, f64)> = car.path.ahead(graph).collect();
        for (place, &(lane, start_m)) in ahead.iter().enumerate() {
            if start_m > horizon_m {
                break;
            }
            if graph.lane(lane).junction.is_none() {
                continue;
            }
            let exit = ahead.get(place + 1).map(|(next, _)| *next);
            let is_inside = start_m < self.cars[index].half_length_m();
            // Room first: `take` reserves the lane, which a waiting vehicle must not keep closed.
            let has_room = is_inside || self.has_exit_room(index, exit);
            let car = &mut self.cars[index];
            // Already across the line: wait in the lane for the others by the swept way alone.
            if has_room && self.right_of_way.take(index as u32, car, lane, self.roads) || is_inside
            {
                continue;
            }
            return Some(Obstacle {
                gap_m: start_m - car.half_length_m() - STOP_LINE_M,
                speed_mps: 0.0,
            });
        }
        None
    }

    /// True if the lane behind a junction has space for one more vehicle.
    fn has_exit_room(&self, index: usize, exit: Option<LaneId>) -> bool {
        let Some(exit) = exit.filter(|exit| self.roads.graph.lane(*exit).junction.is_none()) else {
            return true;
        };
        let mut occupants = self.occupants[exit.0 as usize].iter();
        // The list is sorted by position, so its first entry is the vehicle nearest to the junction.
        let Some(&(s_m, last)) = occupants.find(|(_, other)| *other as usize != index) else {
            return true;
        };
        let last = &self.cars[last as usize];
        let room_m = s_m - last.half_length_m();
        last.speed_mps > MOVING_ON_MPS
            || room_m > 2.0 * self.cars[index].half_length_m() + EXIT_ROOM_M
    }

    /// The nearest vehicle that stands or drives the same way in the strip that the vehicle will sweep: merging lanes,
    /// tails in bends.
    fn in_own_path(&self, index: usize, near: &mut Vec<u32>) -> Option<Obstacle> {
        let car = &self.cars[index];
        // Two vehicles that give way to each other would stand forever.
        if car.standing_s > MOST_STANDING_S {
            return None;
        }
        let reach_m = (6.0 + 2.5 * car.speed_mps).min(30.0);
        let here = car.motion.end;
        let (sin, cos) = here.yaw_rad.sin_cos();
        let radius_m = reach_m + car.half_length_m() + 6.0;
        self.index.near(car.point_m(), radius_m, near);
        near.retain(|&other| {
            let other_car = &self.cars[other as usize];
            let offset = other_car.motion.end.position_m - here.position_m;
            let turned = wrapped(other_car.motion.end.yaw_rad - here.yaw_rad).abs();
            other as usize != index
                // Vehicles on a road above or below are not in the way.
                && offset.z.abs() < 3.0
                && offset.x * cos + offset.y * sin > 0.0
                // Oncoming vehicles (turned by more than 100 degrees) keep to lanes of their own.
                && turned < 1.75
                // A vehicle that drives just ahead on the same lane is the leader already.
                && (other_car.path.lane() != car.path.lane())
        });
        if near.is_empty() {
            return None;
        }
        let half_width_m = (0.5 * car.vehicle.size_m[1] + SIDE_ROOM_M) * here.roll_rad.cos();
        let mut ahead_m = car.half_length_m();
        while ahead_m < car.half_length_m() + reach_m {
            let [x, y, _] = car.path.point_m(self.roads.graph, ahead_m);
            let mut others = near.iter().map(|&other| &self.cars[other as usize]);
            let hit = others.find(|other| other.rectangle().distance_m([x, y]) < half_width_m);
            if let Some(other) = hit {
                let turned = wrapped(other.motion.end.yaw_rad - here.yaw_rad);
                return Some(Obstacle {
                    gap_m: ahead_m - car.half_length_m(),
                    // Only the speed along the own heading opens the gap.
                    speed_mps: (other.speed_mps * turned.cos()).max(0.0),
                });
            }
            ahead_m += SWEEP_STEP_M;
        }
        None
    }

    /// The end of a road without successor.
    fn end_of_the_way(&self, index: usize) -> Option<Obstacle> {
        let car = &self.cars[index];
        let left_m = car.path.remaining_m(self.roads.graph);
        // `Traffic::step` makes every path at least this long, unless its road ends.
        (left_m < super::DECIDED_M).then(|| Obstacle {
            gap_m: left_m - car.half_length_m(),
            speed_mps: 0.0,
        })
    }
}
