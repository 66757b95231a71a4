//! Vehicle shapes: convex parts that a LiDAR can distinguish from a box.

use std::f32::consts::PI;

use strum::VariantArray;

use super::raycast::{Bounds, Convex, SolidShape};
use support::random::SplitMix64;

/// Kinds of road vehicles, in the order of `DRIVING` and `PARKED`.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, VariantArray)]
pub enum VehicleKind {
    /// Three boxes: bonnet, cabin, boot.
    Sedan,
    /// Short, with a steep tail.
    Hatchback,
    /// High, with a long cabin.
    Suv,
    /// A cabin and an open bed.
    Pickup,
    /// One volume with a short nose.
    Van,
    /// A cab and a cargo box.
    Truck,
    /// One long volume.
    Bus,
}

/// One vehicle: its kind, its outer sizes and its form.
///
/// The frame of a vehicle has its origin on the ground under the middle of the box: x forward, y left, z up.
#[derive(Debug, Clone, PartialEq)]
pub struct Vehicle {
    /// Its kind.
    pub kind: VehicleKind,
    /// Full length, width and height of the tight outer box, metres.
    pub size_m: [f64; 3],
    /// Its form.
    pub shape: SolidShape,
}

/// All kinds.
const KINDS: &[VehicleKind] = VehicleKind::VARIANTS;
/// Frequencies of [`KINDS`] in moving traffic and among parked vehicles. Trucks and buses are rare: the clean-up of
/// detections in OpenCOOD's protocol drops boxes longer than 6 m.
const DRIVING: [f64; 7] = [0.36, 0.21, 0.25, 0.05, 0.085, 0.03, 0.015];
const PARKED: [f64; 7] = [0.38, 0.26, 0.24, 0.05, 0.07, 0.0, 0.0];

impl VehicleKind {
    /// True for cars with a low roof, on which a LiDAR is mounted.
    pub(crate) fn is_low(self) -> bool {
        matches!(self, Self::Sedan | Self::Hatchback | Self::Suv)
    }

    /// Mean length, width and height, metres, and the largest deviation of an instance from each, as a share.
    ///
    /// After the vehicles of CARLA. Heights stay under 2.9 m, so that a box stands within -3..1 m of a LiDAR at 1.95 m.
    fn mean_and_spread(self) -> [[f64; 3]; 2] {
        match self {
            Self::Sedan => [[4.65, 1.95, 1.48], [0.07, 0.05, 0.04]],
            Self::Hatchback => [[3.95, 1.85, 1.52], [0.08, 0.05, 0.04]],
            Self::Suv => [[4.65, 2.05, 1.75], [0.07, 0.04, 0.06]],
            Self::Pickup => [[5.30, 2.05, 1.88], [0.05, 0.04, 0.04]],
            Self::Van => [[5.15, 2.05, 2.15], [0.08, 0.04, 0.12]],
            Self::Truck => [[7.10, 2.40, 2.65], [0.12, 0.03, 0.05]],
            Self::Bus => [[10.2, 2.50, 2.82], [0.10, 0.02, 0.015]],
        }
    }
}

impl Vehicle {
    /// A random vehicle with the frequencies of moving traffic.
    pub fn random_driving(random: &mut SplitMix64) -> Self {
        Self::random(random, DRIVING)
    }

    /// A random vehicle with the frequencies of parked vehicles.
    pub(crate) fn random_parked(random: &mut SplitMix64) -> Self {
        Self::random(random, PARKED)
    }

    /// A vehicle that may carry the sensors: one low enough for a LiDAR on its roof.
    pub(crate) fn random_connected(random: &mut SplitMix64) -> Self {
        let weights = std::array::from_fn(|place| match KINDS[place].is_low() {
            true => DRIVING[place],
            false => 0.0,
        });
        Self::random(random, weights)
    }

    /// A random vehicle, with one weight for each of [`KINDS`].
    fn random(random: &mut SplitMix64, weights: [f64; 7]) -> Self {
        let mut draw = random.unit() * weights.iter().sum::<f64>();
        let chosen = KINDS.iter().zip(weights).find(|(_, weight)| {
            draw -= weight;
            draw < 0.0
        });
        // Rounding may leave a rest after the last weight.
        let kind = chosen.map_or(KINDS[0], |(kind, _)| *kind);
        let [mean_m, spread] = kind.mean_and_spread();
        let size_m = std::array::from_fn(|axis| {
            mean_m[axis] * (1.0 + spread[axis] * random.between(-1.0, 1.0))
        });
        Self::new(kind, size_m, random)
    }

    /// A vehicle of given outer sizes; proportions vary from one to the next.
    pub fn new(kind: VehicleKind, size_m: [f64; 3], random: &mut SplitMix64) -> Self {
        let [length, width, height] = size_m.map(|size| size as f32);
        let mut vary =
            |value: f32, share: f32| value * (1.0 + share * random.between(-1.0, 1.0) as f32);
        let form = OuterBox {
            half: 0.5 * length,
            side: 0.5 * width,
            height,
        };
        let parts = match kind {
            VehicleKind::Sedan => form.car(&SideView {
                belt: vary(0.62, 0.04),
                drops: [vary(0.24, 0.1), vary(0.06, 0.2)],
                cabin: [vary(-0.42, 0.05), vary(0.19, 0.1)],
                roof: [vary(-0.25, 0.1), vary(0.03, 0.3)],
            }),
            VehicleKind::Hatchback => form.car(&SideView {
                belt: vary(0.61, 0.04),
                drops: [vary(0.2, 0.1), 0.02],
                cabin: [-0.49, vary(0.25, 0.08)],
                roof: [vary(-0.40, 0.06), vary(0.08, 0.2)],
            }),
            VehicleKind::Suv => form.car(&SideView {
                belt: vary(0.60, 0.04),
                drops: [vary(0.18, 0.1), 0.02],
                cabin: [-0.49, vary(0.22, 0.08)],
                roof: [vary(-0.43, 0.04), vary(0.09, 0.2)],
            }),
            VehicleKind::Pickup => form.car(&SideView {
                belt: vary(0.58, 0.04),
                drops: [vary(0.12, 0.2), 0.01],
                cabin: [vary(-0.1, 0.2), vary(0.22, 0.06)],
                roof: [vary(-0.06, 0.2), vary(0.13, 0.1)],
            }),
            VehicleKind::Van => form.car(&SideView {
                belt: vary(0.52, 0.04),
                drops: [vary(0.1, 0.2), 0.01],
                cabin: [-0.5, vary(0.38, 0.05)],
                roof: [-0.48, vary(0.27, 0.06)],
            }),
            VehicleKind::Truck => form.truck(vary(0.24, 0.1), vary(0.84, 0.06)),
            VehicleKind::Bus => form.bus(),
        };
        Self {
            kind,
            size_m,
            shape: SolidShape::new(parts, vary(0.5, 0.5)),
        }
    }
}

/// Outer box of a vehicle, metres.
struct OuterBox {
    half: f32,
    side: f32,
    height: f32,
}

/// Outline of a car from the side, in shares of the height (`belt`) and of the length (all others).
struct SideView {
    /// Lower edge of the windows.
    belt: f32,
    /// Drops of the bonnet towards the nose and of the boot towards the tail.
    drops: [f32; 2],
    /// Rear and front of the cabin at the belt, from the middle.
    cabin: [f32; 2],
    /// Rear and front of the roof, from the middle.
    roof: [f32; 2],
}

impl OuterBox {
    fn car(&self, view: &SideView) -> Vec<Convex> {
        let Self { half, side, height } = *self;
        let length = 2.0 * half;
        let (floor, bumper, belt) = (0.14 * height, 0.40 * height, view.belt * height);
        let below = [0.05 - half, half - 0.08, side - 0.07];
        let widest = [-half, half, side];
        let [bonnet, boot] = view.drops.map(|share| share * length);
        let [rear, front] = view.cabin.map(|place| place * length);
        let [roof_rear, roof_front] = view.roof.map(|place| place * length);
        let shoulder = [boot - half, half - bonnet, side - 0.05];
        let cabin = [rear, front, side - 0.07];
        let roof = [roof_rear, roof_front, side - 0.26];
        let mut parts = vec![
            frustum([floor, bumper], below, widest),
            frustum([bumper, belt], widest, shoulder),
            frustum([belt, height], cabin, roof),
        ];
        parts.extend(self.wheels(0.33, 0.30 * length, -0.29 * length));
        parts
    }

    /// `cab` is the share of the length before the cargo, `cab_height` of the height.
    fn truck(&self, cab: f32, cab_height: f32) -> Vec<Convex> {
        let Self { half, side, height } = *self;
        let length = 2.0 * half;
        let front = half - cab * length;
        let (frame, cargo) = ([-half, front, side * 0.5], [-half, front - 0.15, side]);
        let cab_top = [front, half, side - 0.05];
        let windscreen = [0.5 * height, cab_height * height];
        let mut parts = vec![
            frustum([0.55, 0.95], frame, frame),
            frustum([0.95, height], cargo, cargo),
            frustum([0.35, 0.5 * height], [front, half, side - 0.08], cab_top),
            frustum(windscreen, cab_top, [front, half - 0.45, side - 0.2]),
        ];
        parts.extend(self.wheels(0.48, self.half - 0.55 * cab * length, -0.32 * length));
        parts
    }

    fn bus(&self) -> Vec<Convex> {
        let Self { half, side, height } = *self;
        let (below, widest) = ([-half, half, side - 0.03], [-half, half, side]);
        let roof = [0.1 - half, half - 0.25, side - 0.12];
        let mut parts = vec![
            frustum([0.30, 1.10], below, widest),
            frustum([1.10, height], widest, roof),
        ];
        parts.extend(self.wheels(0.48, 0.30 * 2.0 * self.half, -0.26 * 2.0 * self.half));
        parts
    }

    fn wheels(&self, radius: f32, front: f32, rear: f32) -> Vec<Convex> {
        [(front, 1.0), (front, -1.0), (rear, 1.0), (rear, -1.0)]
            .map(|(x, side)| wheel([x, side * (self.side - 0.14), radius], radius, 0.12))
            .into()
    }
}

/// A solid between two level rectangles: heights `[bottom, top]`, and for each `[rear x, front x, half width]`.
fn frustum(
    [bottom, top]: [f32; 2],
    [rear0, front0, side0]: [f32; 3],
    [rear1, front1, side1]: [f32; 3],
) -> Convex {
    let rise = top - bottom;
    // Faces through (at0, bottom) and (at1, top), with their normals towards growing `at`.
    // The rear is a front seen backwards: its `at` grows towards negative x.
    let edges = [[front0, front1], [-rear0, -rear1], [side0, side1]];
    let [front, rear, left] = edges.map(|[at0, at1]| {
        let (norm, back) = (rise.hypot(at0 - at1), at0 - at1);
        [rise, back, rise * at0 + back * bottom].map(|value| value / norm)
    });
    let planes = vec![
        [front[0], 0.0, front[1], front[2]],
        [-rear[0], 0.0, rear[1], rear[2]],
        [0.0, left[0], left[1], left[2]],
        [0.0, -left[0], left[1], left[2]],
        [0.0, 0.0, 1.0, top],
        [0.0, 0.0, -1.0, -bottom],
    ];
    let side = side0.max(side1);
    let bounds = Bounds {
        min_m: [rear0.min(rear1), -side, bottom],
        max_m: [front0.max(front1), side, top],
    };
    Convex::Hull { planes, bounds }
}

/// An upright octagon that stands on the ground.
fn wheel(center: [f32; 3], radius: f32, half_width: f32) -> Convex {
    // Four faces are perpendicular to x or z, so the octagon reaches exactly to its bounds.
    let rim = (0..8).map(|face| {
        let (sin, cos) = (face as f32 * PI / 4.0).sin_cos();
        [cos, 0.0, sin, cos * center[0] + sin * center[2] + radius]
    });
    let sides = [
        [0.0, 1.0, 0.0, center[1] + half_width],
        [0.0, -1.0, 0.0, half_width - center[1]],
    ];
    Convex::Hull {
        planes: rim.chain(sides).collect(),
        bounds: Bounds::centered(center, [radius, half_width, radius]),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn fleet() -> Vec<Vehicle> {
        let mut random = SplitMix64::new(5);
        (0..2000)
            .map(|_| Vehicle::random_driving(&mut random))
            .collect()
    }

    #[test]
    fn every_kind_occurs_and_fills_its_box() {
        let fleet = fleet();
        for kind in KINDS {
            assert!(
                fleet.iter().any(|vehicle| vehicle.kind == *kind),
                "{kind:?}"
            );
        }
        for vehicle in &fleet {
            let bounds = vehicle.shape.bounds;
            let [length, width, height] = vehicle.size_m;
            let expected = [
                -length / 2.0,
                -width / 2.0,
                0.0,
                length / 2.0,
                width / 2.0,
                height,
            ];
            let actual = bounds.min_m.into_iter().chain(bounds.max_m);
            for (expected, actual) in expected.into_iter().zip(actual) {
                assert!(
                    (expected - f64::from(actual)).abs() < 1e-4,
                    "{:?}: {expected} {actual}",
                    vehicle.kind
                );
            }
            assert!(height < 2.9);
        }
    }

    #[test]
    fn a_frustum_is_bounded_by_its_rectangles() {
        let Convex::Hull { planes, .. } = frustum([0.5, 1.5], [-2.0, 2.0, 1.0], [-1.0, 0.5, 0.7])
        else {
            panic!("a frustum is a hull");
        };
        for corner in [
            [2.0, 1.0, 0.5],
            [-2.0, -1.0, 0.5],
            [0.5, 0.7, 1.5],
            [-1.0, -0.7, 1.5],
        ] {
            let slack: Vec<f32> = planes
                .iter()
                .map(|p| p[3] - (0..3).map(|axis| p[axis] * corner[axis]).sum::<f32>())
                .collect();
            assert!(
                slack.iter().all(|&slack| slack > -1e-5),
                "{corner:?} lies outside"
            );
            assert_eq!(
                slack.iter().filter(|&&slack| slack.abs() < 1e-5).count(),
                3,
                "{corner:?} is no corner"
            );
        }
    }
}
