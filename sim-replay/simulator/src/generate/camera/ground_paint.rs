//! Paint of the ground: road, grass or snow, by place.

use std::collections::HashMap;

use nalgebra::Vector3;

use super::paint::{Colour, SNOW, mix};
use crate::generate::weather::Weather;
use crate::generate::world::World;
use support::random::SplitMix64;

const ASPHALT: Colour = [0.26, 0.26, 0.27];
const GRASS: Colour = [0.33, 0.40, 0.20];
/// Edge of a cell of ground of one material, metres.
const CELL_M: f64 = 0.4;
/// Distance from a lane's centre line that is still road beside its half width, metres.
const SHOULDER_M: f64 = 0.3;
/// Largest lane that is looked for, metres.
const WIDEST_LANE_M: f64 = 6.0;

/// Material of the ground, looked up once for each cell.
pub(crate) struct GroundPaint<'w> {
    world: &'w World<'w>,
    is_road: HashMap<[i32; 2], bool>,
}

impl<'w> GroundPaint<'w> {
    pub(crate) fn new(world: &'w World<'w>) -> Self {
        Self {
            world,
            is_road: HashMap::new(),
        }
    }

    pub(super) fn colour(&mut self, place_m: &Vector3<f64>, weather: Weather) -> Colour {
        let cell = [place_m.x, place_m.y].map(|axis| (axis / CELL_M).floor() as i32);
        let world = self.world;
        let is_road = *self.is_road.entry(cell).or_insert_with(|| {
            let middle = cell.map(|axis| (f64::from(axis) + 0.5) * CELL_M);
            let lanes = &world.map_model.lanes;
            let index = &world.lane_index;
            let nearest = index.nearest(lanes, middle, WIDEST_LANE_M, None);
            nearest.is_some_and(|at| {
                at.offset_m.abs() < lanes.lane(at.lane).width_m / 2.0 + SHOULDER_M
            })
        });
        // A little of each cell's own, so that flat ground shows its distance.
        let seed = (u64::from(cell[0].cast_unsigned()) << 32) | u64::from(cell[1].cast_unsigned());
        let grain = 0.94 + 0.12 * SplitMix64::new(seed).unit() as f32;
        let colour = match (weather, is_road) {
            (Weather::Snow, false) => SNOW,
            (Weather::Snow, true) => mix(ASPHALT, SNOW, 0.55),
            (_, true) => ASPHALT,
            (_, false) => GRASS,
        };
        colour.map(|part| part * grain)
    }
}
