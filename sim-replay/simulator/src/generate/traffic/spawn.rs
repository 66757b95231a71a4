//! Spawning and removal of vehicles.

use super::car::{Car, LaneChangeState};
use super::driver::Driver;
use super::explorer::Explorer;
use super::junction::RightOfWay;
use super::path::Path;
use super::rectangle::{NeighbourIndex, Rectangle};
use super::roads::{Roads, Spawn};
use super::{STEP_S, Traffic, TrafficOptions};
use crate::generate::raycast::Course;
use crate::generate::vehicle::Vehicle;
use support::random::SplitMix64;

/// New vehicles are placed at most this far inside the edge, metres.
const EDGE_M: f64 = 35.0;
/// Free room before and behind a new vehicle, metres.
const SPAWN_ROOM_M: f64 = 4.0;
/// Vehicles that stand longer than this without a vehicle before them are gridlocked, and leave, seconds.
const STUCK_S: f64 = 45.0;
/// Interval at which vehicles near a blocked focus leave, seconds.
const NEXT_LEAVES_S: f64 = 5.0;
/// A vehicle that stands farther behind its leader than this counts as having none, metres.
const QUEUE_GAP_M: f64 = 8.0;
/// Tries to place one vehicle in one step.
const TRIES: usize = 4;
/// The id of the focus; all others follow.
const FOCUS_ID: i64 = 1000;

impl<'t> Traffic<'t> {
    /// Traffic around a focus that starts at `start`, parked vehicles given by their footprints.
    pub(crate) fn new(
        roads: &'t Roads<'t>,
        parked: &'t [Rectangle],
        options: TrafficOptions,
        start: Spawn,
        seed: u64,
    ) -> Self {
        let mut parked_index = NeighbourIndex::default();
        for (spot, rectangle) in parked.iter().enumerate() {
            parked_index.insert(spot as u32, rectangle.center_m);
        }
        let lanes = roads.graph.lanes.len();
        let mut traffic = Self {
            roads,
            parked,
            parked_index,
            options,
            cars: Vec::new(),
            right_of_way: RightOfWay::new(lanes),
            occupants: vec![Vec::new(); lanes],
            index: NeighbourIndex::default(),
            random: SplitMix64::new(seed),
            next_id: FOCUS_ID,
            explorer: options
                .focus_explores
                .then(|| Explorer::new(roads, start.lane)),
        };
        let focus = Vehicle::random_connected(&mut traffic.random);
        traffic.add(focus, start);
        traffic.fill(start.point_m);
        traffic
    }

    /// Puts vehicles on all lanes around the focus.
    fn fill(&mut self, center_m: [f64; 2]) {
        let radius_m = self.options.radius_m;
        let mut spawns: Vec<Spawn> = self.spawns_between(center_m, 0.0, radius_m);
        // Spawn places are 4 m apart (SPAWN_STEP_M of `roads`).
        let lane_km = spawns.len() as f64 * 4.0 / 1000.0;
        let wanted = (lane_km * self.options.vehicles_per_km).round() as usize;
        self.random.shuffle(&mut spawns);
        let mut near = Vec::new();
        for spawn in spawns {
            // The focus comes on top of the wanted density.
            if self.cars.len() > wanted {
                return;
            }
            let vehicle = Vehicle::random_driving(&mut self.random);
            if self.has_room(&vehicle, spawn, usize::MAX, &mut near) {
                self.add(vehicle, spawn);
            }
        }
    }

    fn spawns_between(&self, center_m: [f64; 2], low_m: f64, high_m: f64) -> Vec<Spawn> {
        let spawns = self.roads.spawns.iter();
        let inside =
            spawns.filter(|spawn| (low_m..high_m).contains(&distance_m(spawn.point_m, center_m)));
        inside.copied().collect()
    }

    fn has_room(&self, vehicle: &Vehicle, spawn: Spawn, index: usize, near: &mut Vec<u32>) -> bool {
        let path = Path::new(spawn.lane, spawn.s_m);
        let wheelbase_m = 0.6 * vehicle.size_m[0];
        let placement = path.placement(self.roads.graph, 0.0, wheelbase_m, 0.0);
        let mut footprint = Rectangle::new(&placement, &vehicle.size_m).grown(0.4);
        footprint.half_m[0] += SPAWN_ROOM_M;
        self.is_free(index, &footprint, near)
    }

    pub(super) fn add(&mut self, vehicle: Vehicle, spawn: Spawn) {
        let driver = Driver::random(&mut self.random);
        let path = Path::new(spawn.lane, spawn.s_m);
        let aside_m = self.random.between(-0.2, 0.2);
        let lane_change = LaneChangeState {
            held_up_s: 0.0,
            random_change: None,
            random_change_timer_s: self.random.between(0.0, 50.0),
        };
        let placement = path.placement(self.roads.graph, 0.0, 0.6 * vehicle.size_m[0], aside_m);
        let speed_mps = 0.6 * driver.pace * self.roads.speed_mps(spawn.lane, spawn.s_m);
        let index = self.cars.len() as u32;
        self.index.insert(index, placement.position_m.xy().into());
        self.cars.push(Car {
            id: self.next_id,
            vehicle,
            driver,
            path,
            aside_m,
            speed_mps,
            leader: None,
            lane_change,
            motion: Course::still(placement),
            is_present: true,
            standing_s: 0.0,
            held: Vec::new(),
        });
        self.next_id += 1;
    }

    /// Removes vehicles that are too far from the focus, at the end of a road or stuck, and places new ones at the
    /// edge.
    ///
    /// Full roundabouts and long vehicles in a junction cause gridlocks that waiting does not resolve; as in other
    /// traffic simulations, the vehicle that has stood longest at the head of a queue then leaves the scene.
    pub(super) fn exchange_far_cars(&mut self) {
        let center_m = self.cars[0].point_m();
        let stuck = self.longest_stuck();
        let mut edge: Option<Vec<Spawn>> = None;
        let mut near = Vec::new();
        for index in 1..self.cars.len() {
            let car = &self.cars[index];
            if car.is_present {
                let point_m = car.point_m();
                let distance_m = distance_m(point_m, center_m);
                // Just before the end, where it would otherwise stop for good.
                let is_at_an_end =
                    car.path.remaining_m(self.roads.graph) < car.half_length_m() + 3.0;
                if distance_m > self.options.radius_m || is_at_an_end || Some(index) == stuck {
                    self.index.remove(index as u32, point_m);
                    let car = &mut self.cars[index];
                    car.is_present = false;
                    // Its lanes must not stay closed for others.
                    self.right_of_way
                        .release_behind(index as u32, car, self.roads);
                }
                continue;
            }
            let low_m = self.options.radius_m - EDGE_M;
            let edge = edge
                .get_or_insert_with(|| self.spawns_between(center_m, low_m, self.options.radius_m));
            for _ in 0..TRIES.min(edge.len()) {
                let spawn = edge[self.random.below(edge.len())];
                if self.has_room(&self.cars[index].vehicle, spawn, index, &mut near) {
                    let speed = self.roads.speed_mps(spawn.lane, spawn.s_m);
                    let car = &mut self.cars[index];
                    car.id = self.next_id;
                    car.path = Path::new(spawn.lane, spawn.s_m);
                    car.motion = Course::still(car.placement_after(self.roads, 0.0));
                    car.speed_mps = 0.6 * car.driver.pace * speed;
                    car.leader = None;
                    car.is_present = true;
                    car.standing_s = 0.0;
                    self.index.insert(index as u32, car.point_m());
                    self.next_id += 1;
                    break;
                }
            }
        }
    }

    /// The vehicle that has stood longest at the head of a queue, if that is too long; the focus stays, and the
    /// vehicles around it leave one by one.
    fn longest_stuck(&self) -> Option<usize> {
        let over_s = self.cars[0].standing_s - STUCK_S;
        // True in one step of each interval, so that one vehicle leaves at a time.
        if over_s > 0.0 && over_s % NEXT_LEAVES_S < STEP_S {
            let center_m = self.cars[0].point_m();
            let standing = (1..self.cars.len()).filter(|&index| {
                let car = &self.cars[index];
                car.is_present && car.standing_s > NEXT_LEAVES_S
            });
            let away_m = |index: usize| distance_m(self.cars[index].point_m(), center_m);
            return standing.min_by(|&a, &b| away_m(a).total_cmp(&away_m(b)));
        }
        let stuck = (1..self.cars.len()).filter(|&index| {
            let car = &self.cars[index];
            let is_first = car.leader.is_none_or(|leader| leader.gap_m > QUEUE_GAP_M);
            car.is_present && car.standing_s > STUCK_S && is_first
        });
        stuck.max_by(|&a, &b| self.cars[a].standing_s.total_cmp(&self.cars[b].standing_s))
    }
}

fn distance_m(a: [f64; 2], b: [f64; 2]) -> f64 {
    (a[0] - b[0]).hypot(a[1] - b[1])
}
