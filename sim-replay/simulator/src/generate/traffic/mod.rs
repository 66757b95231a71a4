//! Vehicles that follow lanes, keep distance, slow down for bends, give way at junctions and change lanes.
//!
//! Traffic is simulated around one vehicle, the focus: a vehicle too far from it leaves, and another one enters at the
//! edge, out of sight. No two vehicles ever overlap: with priority over all traffic rules, a vehicle moves only into
//! free space.

mod car;
mod driver;
mod explorer;
mod junction;
mod lane_change;
mod look_ahead;
mod path;
mod rectangle;
mod roads;
mod spawn;
#[cfg(test)]
mod tests;

pub(crate) use car::Car;
pub(crate) use rectangle::{NeighbourIndex, Rectangle};
pub(crate) use roads::Roads;

use explorer::Explorer;
use junction::RightOfWay;

use super::raycast::Course;
use crate::map::LaneId;
use support::random::SplitMix64;

/// Simulated time of one step, seconds: one turn of the LiDAR.
pub(crate) const STEP_S: f64 = 0.05;
/// Clearance that a moving vehicle keeps to everything, metres.
const CLEARANCE_M: f64 = 0.1;
/// The path ahead is decided at least this far, metres.
const DECIDED_M: f64 = 90.0;

/// Parameters of traffic.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct TrafficOptions {
    /// Vehicles per kilometre of lane around the focus.
    pub(crate) vehicles_per_km: f64,
    /// Vehicles farther than this from the focus leave, metres.
    pub(crate) radius_m: f64,
    /// True if the focus explores less visited roads, instead of wandering at random.
    pub(crate) focus_explores: bool,
}

/// State of the traffic.
#[derive(Debug)]
pub(crate) struct Traffic<'t> {
    pub(super) roads: &'t Roads<'t>,
    /// Footprints of parked vehicles.
    parked: &'t [Rectangle],
    parked_index: NeighbourIndex,
    options: TrafficOptions,
    /// The focus is the first.
    pub(crate) cars: Vec<Car>,
    right_of_way: RightOfWay,
    /// Vehicles by lane, as position along it and index, in order.
    occupants: Vec<Vec<(f64, u32)>>,
    index: NeighbourIndex,
    random: SplitMix64,
    next_id: i64,
    /// State of the exploration, if the focus explores.
    explorer: Option<Explorer>,
}

impl<'t> Traffic<'t> {
    /// Moves all vehicles by one [`STEP_S`].
    pub(crate) fn step(&mut self) {
        let mut near = Vec::new();
        self.list_occupants();
        self.change_lanes(&mut near);
        // Paths that are too short get further lanes: the look-ahead of this step needs the next ones of every vehicle.
        for index in 0..self.cars.len() {
            while self.cars[index].is_present
                && self.cars[index].path.remaining_m(self.roads.graph) < DECIDED_M
            {
                let Some(next) = self.choose_next(index) else {
                    break;
                };
                self.cars[index].path.push(next);
            }
        }
        // By rising index: a vehicle sees those before it where they are after this step.
        for index in self.present() {
            let acceleration = self.acceleration_mps2(index, &mut near);
            let car = &self.cars[index];
            let speed = (car.speed_mps + acceleration * STEP_S).max(0.0);
            self.drive(index, speed, &mut near);
        }
        for index in 0..self.cars.len() {
            self.right_of_way
                .release_behind(index as u32, &mut self.cars[index], self.roads);
        }
        self.exchange_far_cars();
    }

    /// Indices of the cars that are on the road.
    fn present(&self) -> Vec<usize> {
        (0..self.cars.len())
            .filter(|&index| self.cars[index].is_present)
            .collect()
    }

    /// Moves one vehicle, unless another one blocks it.
    fn drive(&mut self, index: usize, speed_mps: f64, near: &mut Vec<u32>) {
        let car = &self.cars[index];
        let distance_m = speed_mps * STEP_S;
        let (start, from) = (car.motion.end, car.point_m());
        let end = car.placement_after(self.roads, distance_m);
        let footprint = Rectangle::new(&end, &car.vehicle.size_m).grown(CLEARANCE_M);
        // A vehicle that would touch another one stops where it is, whatever its driver wanted.
        let is_free = speed_mps == 0.0 || self.is_free(index, &footprint, near);
        let car = &mut self.cars[index];
        if is_free {
            car.path
                .advance(self.roads.graph, distance_m, car.vehicle.size_m[0]);
            car.motion = Course {
                start,
                end: if speed_mps == 0.0 { start } else { end },
            };
            car.speed_mps = speed_mps;
        } else {
            car.motion = Course::still(start);
            car.speed_mps = 0.0;
        }
        car.standing_s += STEP_S;
        if car.speed_mps >= 0.1 {
            car.standing_s = 0.0;
        }
        let to = car.point_m();
        self.index.relocate(index as u32, from, to);
    }

    /// True if no vehicle except `index` touches a footprint.
    fn is_free(&self, index: usize, footprint: &Rectangle, near: &mut Vec<u32>) -> bool {
        // Entries are centres: 9 m exceeds the radius of the longest vehicle.
        let radius_m = footprint.radius_m() + 9.0;
        self.index.near(footprint.center_m, radius_m, near);
        if near.iter().any(|&other| {
            other as usize != index && self.cars[other as usize].rectangle().overlaps(footprint)
        }) {
            return false;
        }
        self.parked_index.near(footprint.center_m, radius_m, near);
        let mut parked = near.iter().map(|&spot| &self.parked[spot as usize]);
        !parked.any(|parked| parked.overlaps(footprint))
    }

    fn list_occupants(&mut self) {
        self.occupants.iter_mut().for_each(Vec::clear);
        let cars = self.cars.iter().enumerate();
        for (index, car) in cars.filter(|(_, car)| car.is_present) {
            self.occupants[car.path.lane().0 as usize].push((car.path.s_m, index as u32));
            // Vehicles behind it on the lane that it leaves must not hit it.
            if let Some((lane, s_m)) = car.path.leaving(self.roads.graph) {
                self.occupants[lane.0 as usize].push((s_m, index as u32));
            }
        }
        for lane in &mut self.occupants {
            // Ties are broken by index, so that the order does not depend on earlier steps.
            lane.sort_unstable_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
        }
    }

    fn choose_next(&mut self, index: usize) -> Option<LaneId> {
        let mut onward = self.roads.onward(self.cars[index].path.last());
        let mut explorer = self.explorer.as_mut().filter(|_| index == 0);
        if let Some(explorer) = &mut explorer {
            explorer.keep_best(&mut onward);
        }
        // At the end of a road the list is empty, and `get` finds nothing.
        let next = *onward.get(self.random.below(onward.len()))?;
        if let Some(explorer) = explorer {
            explorer.choose(next);
        }
        Some(next)
    }
}
