//! Paint of what cameras see.

use crate::generate::raycast::{Convex, SolidShape};
use support::random::SplitMix64;

/// Colour of a surface in white light, 0..1 red, green, blue.
pub(crate) type Colour = [f32; 3];

/// Paint of a body.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) enum Paint {
    /// Body of a vehicle.
    Vehicle(Colour),
    /// Wall with rows of windows.
    Wall(Colour),
    /// One colour.
    Plain(Colour),
}

/// Colour of lying and falling snow.
pub(super) const SNOW: Colour = [0.88, 0.89, 0.92];
/// Colours of vehicles.
const VEHICLES: [Colour; 8] = [
    [0.85, 0.85, 0.86],
    [0.08, 0.08, 0.09],
    [0.55, 0.57, 0.60],
    [0.62, 0.10, 0.10],
    [0.10, 0.20, 0.48],
    [0.30, 0.31, 0.33],
    [0.75, 0.68, 0.50],
    [0.12, 0.36, 0.24],
];
/// Colours of walls.
const WALLS: [Colour; 5] = [
    [0.70, 0.62, 0.52],
    [0.58, 0.36, 0.30],
    [0.74, 0.73, 0.70],
    [0.52, 0.54, 0.57],
    [0.80, 0.74, 0.60],
];
const LEAVES: Colour = [0.20, 0.36, 0.12];
const TRUNK: Colour = [0.34, 0.30, 0.27];
/// Least height of a box that is a building, metres.
const BUILDING_M: f32 = 3.0;

/// Paint of a vehicle by its id.
pub(crate) fn of_vehicle(id: i64) -> Paint {
    let mut random = SplitMix64::new(id.unsigned_abs().wrapping_mul(0x9e37_79b9_7f4a_7c15));
    Paint::Vehicle(VEHICLES[random.below(VEHICLES.len())])
}

/// Paint of a static object by its form; `place` tells neighbours apart.
pub(crate) fn of_shape(shape: &SolidShape, place: u64) -> Paint {
    match shape.parts.first() {
        Some(Convex::Ellipsoid { .. }) => Paint::Plain(LEAVES),
        Some(Convex::Cylinder { .. }) => Paint::Plain(TRUNK),
        _ => {
            let colour = WALLS[SplitMix64::new(place).below(WALLS.len())];
            let height_m = shape.bounds.max_m[2] - shape.bounds.min_m[2];
            if height_m > BUILDING_M {
                Paint::Wall(colour)
            } else {
                Paint::Plain(colour.map(|part| 0.8 * part))
            }
        }
    }
}

/// `a`, by a share towards `b`.
pub(super) fn mix(a: Colour, b: Colour, share: f32) -> Colour {
    std::array::from_fn(|part| a[part] + (b[part] - a[part]) * share)
}
