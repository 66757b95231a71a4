//! Parked vehicles: occupancy and vehicle of each spot.

use super::raycast::{Placement, wrapped};
use super::traffic::Rectangle;
use super::vehicle::Vehicle;
use crate::map::{LaneIndex, MapModel, ParkingSpot};
use support::random::SplitMix64;

/// Ids of parked vehicles begin here; the number of the spot is added.
const FIRST_ID: i64 = 20_000;
/// A lane's middle keeps at least this distance to a parked vehicle, metres: half a wide vehicle and some room.
const LANE_ROOM_M: f64 = 1.45;

/// A vehicle that stands at the kerb for the whole scene.
#[derive(Debug, Clone)]
pub(crate) struct ParkedVehicle {
    pub(crate) id: i64,
    pub(crate) vehicle: Vehicle,
    pub(crate) placement: Placement,
}

impl ParkedVehicle {
    /// Its outline on the ground.
    pub(crate) fn rectangle(&self) -> Rectangle {
        Rectangle::new(&self.placement, &self.vehicle.size_m)
    }
}

/// Parks vehicles on the spots of a map; the occupancy differs from seed to seed.
pub(crate) fn park(map_model: &MapModel, lanes: &LaneIndex, seed: u64) -> Vec<ParkedVehicle> {
    let mut random = SplitMix64::new(seed);
    let occupancy = random.between(0.3, 0.7);
    let mut parked: Vec<ParkedVehicle> = Vec::new();
    for (number, spot) in map_model.parking.iter().enumerate() {
        // Each spot has its own random stream: an added spot does not change the others.
        let mut random = SplitMix64::derived(seed, &[number as u64]);
        if !random.chance(occupancy) {
            continue;
        }
        let mut draws = (0..8).map(|_| Vehicle::random_parked(&mut random));
        let Some(vehicle) = draws.find(|vehicle| {
            vehicle.size_m[0] + 0.3 < spot.length_m && vehicle.size_m[1] < spot.width_m
        }) else {
            continue;
        };
        let candidate = ParkedVehicle {
            id: FIRST_ID + number as i64,
            placement: place(spot, &vehicle, &mut random),
            vehicle,
        };
        let rectangle = candidate.rectangle();
        let room = rectangle.grown(0.1);
        if stands_on_a_lane(map_model, lanes, &rectangle)
            || parked.iter().any(|other| room.overlaps(&other.rectangle()))
        {
            continue;
        }
        parked.push(candidate);
    }
    parked
}

fn place(spot: &ParkingSpot, vehicle: &Vehicle, random: &mut SplitMix64) -> Placement {
    let along = (spot.length_m - vehicle.size_m[0]) * 0.4 * random.between(-1.0, 1.0);
    let aside = (spot.width_m - vehicle.size_m[1]).min(0.4) * 0.5 * random.between(-1.0, 1.0);
    let is_reversed = random.chance(0.15);
    let yaw = spot.yaw_rad + random.between(-0.03, 0.03);
    let (sin, cos) = spot.yaw_rad.sin_cos();
    let [x, y, z] = spot.center_m;
    let position_m = [
        x + along * cos - aside * sin,
        y + along * sin + aside * cos,
        z + aside * spot.roll_rad.tan(),
    ];
    // Turned round, the vehicle has its left side where its right side was.
    let (turn, roll_rad) = match is_reversed {
        true => (std::f64::consts::PI, -spot.roll_rad),
        false => (0.0, spot.roll_rad),
    };
    Placement {
        roll_rad,
        ..Placement::level(position_m, wrapped(yaw + turn))
    }
}

fn stands_on_a_lane(map_model: &MapModel, lanes: &LaneIndex, rectangle: &Rectangle) -> bool {
    let ([x, y], [c, s], [length, width]) = (rectangle.center_m, rectangle.axis, rectangle.half_m);
    let ends = [-1.0, 1.0, 0.0].into_iter();
    let outline = ends.flat_map(|along| [-1.0, 1.0].map(|aside| (along, aside)));
    outline.chain([(0.0, 0.0)]).any(|(along, aside)| {
        let (dx, dy) = (along * length, aside * width);
        let point = [x + dx * c - dy * s, y + dx * s + dy * c];
        let (graph, z_m) = (&map_model.lanes, Some(rectangle.z_m));
        lanes.nearest(graph, point, LANE_ROOM_M, z_m).is_some()
    })
}
