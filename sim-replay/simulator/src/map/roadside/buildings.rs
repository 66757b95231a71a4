//! Buildings, each composed of boxes and cylinders within its lot.
//!
//! A building has its [`PartFootprint`] in the centre of its lot, facing along the street, with the street on its
//! right: `u` runs along the street, `v` away from it. No part reaches beyond the lot.

use std::ops::Range;

use rand::Rng;
use rand_chacha::ChaCha8Rng;

use super::super::{Solid, SolidKind};
use super::parts::PartFootprint;

/// Depth to which buildings reach into the ground, so that none floats on a slope, metres.
const FOOTING_M: f64 = 1.0;

/// Kinds of buildings.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Style {
    House,
    Row,
    Block,
    Tower,
    Shop,
    Hall,
    Church,
    Tanks,
    PetrolStation,
}

/// A lot to build on.
#[derive(Debug, Clone, Copy)]
pub(super) struct Lot {
    pub foot: PartFootprint,
    /// Length along the street, metres.
    pub width_m: f64,
    /// Length away from the street, metres.
    pub depth_m: f64,
}

/// Adds the parts of a building on a lot of this width and depth, metres.
type AddParts = fn(&mut Draft, [f64; 2], &mut ChaCha8Rng);

impl Style {
    /// Ranges of width and depth of a lot for this style, metres, and its parts.
    fn plan(self) -> (Range<f64>, Range<f64>, AddParts) {
        match self {
            Self::House => (8.0..14.0, 8.0..12.0, house),
            Self::Row => (18.0..36.0, 9.0..12.0, row),
            Self::Block => (18.0..32.0, 14.0..22.0, block),
            Self::Tower => (16.0..24.0, 16.0..24.0, tower),
            Self::Shop => (12.0..26.0, 10.0..18.0, shop),
            Self::Hall => (22.0..38.0, 16.0..28.0, hall),
            Self::Church => (14.0..18.0, 24.0..32.0, church),
            Self::Tanks => (14.0..22.0, 10.0..14.0, tanks),
            Self::PetrolStation => (24.0..30.0, 18.0..22.0, petrol_station),
        }
    }

    /// Width and depth of a lot for this style, metres.
    pub(super) fn lot_m(self, rng: &mut ChaCha8Rng) -> [f64; 2] {
        let (width, depth, _) = self.plan();
        [rng.random_range(width), rng.random_range(depth)]
    }
}

/// The solids of a building.
pub(super) fn build(style: Style, lot: &Lot, rng: &mut ChaCha8Rng) -> Vec<Solid> {
    let mut draft = Draft {
        foot: lot.foot,
        reflectivity: rng.random_range(0.15..0.75),
        parts: Vec::new(),
    };
    let (.., add_parts) = style.plan();
    add_parts(&mut draft, [lot.width_m, lot.depth_m], rng);
    draft.parts
}

/// A building under construction.
struct Draft {
    foot: PartFootprint,
    reflectivity: f32,
    parts: Vec<Solid>,
}

impl Draft {
    /// A box from the ground up.
    fn body(&mut self, u: f64, v: f64, [width, depth, height]: [f64; 3]) {
        self.block_at([u, v, -FOOTING_M], [width, depth, height + FOOTING_M]);
    }

    /// A box whose lower side is at `at[2]`.
    fn block_at(&mut self, at: [f64; 3], size: [f64; 3]) {
        let (foot, kind) = (self.foot, SolidKind::Building);
        let part = foot.cuboid(kind, at, size, self.reflectivity);
        self.parts.push(part);
    }

    fn cylinder(&mut self, at: [f64; 3], size: [f64; 2]) {
        let (foot, kind) = (self.foot, SolidKind::Building);
        let part = foot.cylinder(kind, at, size, self.reflectivity);
        self.parts.push(part);
    }

    /// A gabled roof as steps, its ridge along `u` or along `v`.
    fn gable(&mut self, [u, v, z]: [f64; 3], size: [f64; 2], rise: f64, ridge_along_u: bool) {
        const STEPS: u32 = 4;
        let ([width, depth], height) = (size, rise / f64::from(STEPS));
        for step in 0..STEPS {
            let share = 1.0 - f64::from(step) / f64::from(STEPS);
            let [width, depth] = match ridge_along_u {
                true => [width, depth * share],
                false => [width * share, depth],
            };
            let z = z + f64::from(step) * height;
            self.block_at([u, v, z], [width, depth, height]);
        }
    }
}

fn house(draft: &mut Draft, [width, depth]: [f64; 2], rng: &mut ChaCha8Rng) {
    let has_one_floor = rng.random_bool(0.5);
    let height = rng.random_range(if has_one_floor { 2.8..3.6 } else { 5.2..6.6 });
    // The porch takes the first metre and a half of the lot.
    let porch = 1.4;
    let (body_depth, v) = (depth - porch, porch / 2.0);
    let with_garage = width > 11.0 && rng.random_bool(0.6);
    let garage = if with_garage { 3.4 } else { 0.0 };
    let side = if rng.random_bool(0.5) { 1.0 } else { -1.0 };
    let (body_width, u) = (width - garage, -side * garage / 2.0);
    draft.body(u, v, [body_width, body_depth, height]);
    match rng.random_range(0..4) {
        0 => draft.block_at([u, v, height], [body_width, body_depth, 0.4]),
        roof => {
            let (size, rise) = ([body_width, body_depth], rng.random_range(2.0..4.0));
            draft.gable([u, v, height], size, rise, roof != 1);
        }
    }
    let chimney_u = u + rng.random_range(-0.3..0.3) * body_width;
    let chimney = [0.6, 0.6, rng.random_range(2.2..3.6)];
    draft.block_at([chimney_u, v + 0.2 * body_depth, height + 1.0], chimney);
    let door = u + rng.random_range(-0.3..0.3) * body_width;
    let front = -depth / 2.0 + porch / 2.0;
    match rng.random_range(0..3) {
        // A bay, a canopy on two posts, a flight of steps.
        0 => draft.body(door, front, [2.4, porch, height * 0.8]),
        1 => {
            draft.block_at([door, front, 2.4], [2.6, porch, 0.2]);
            for post in [-1.2, 1.2] {
                draft.cylinder([door + post, front - 0.5, 0.0], [0.08, 2.4]);
            }
        }
        _ => draft.body(door, front, [1.8, porch, 0.5]),
    }
    if with_garage {
        let deep = (body_depth * 0.7).max(5.0).min(body_depth);
        let (u, v) = (side * (width - garage) / 2.0, v + (body_depth - deep) / 2.0);
        draft.body(u, v, [garage - 0.1, deep, 2.6]);
    }
}

fn row(draft: &mut Draft, [width, depth]: [f64; 2], rng: &mut ChaCha8Rng) {
    let units = (width / rng.random_range(5.0..7.5)).round().max(2.0) as u32;
    let each = width / f64::from(units);
    let height = rng.random_range(5.5..9.5);
    let gabled = rng.random_bool(0.6);
    for unit in 0..units {
        let u = -width / 2.0 + (f64::from(unit) + 0.5) * each;
        let back = rng.random_range(0.8..1.8);
        let own = height + rng.random_range(-0.8..0.8);
        let size = [each, depth - back];
        draft.reflectivity = rng.random_range(0.15..0.75);
        draft.body(u, back / 2.0, [size[0], size[1], own]);
        if gabled {
            let rise = rng.random_range(1.8..3.0);
            draft.gable([u, back / 2.0, own], size, rise, rng.random_bool(0.75));
        } else {
            draft.block_at([u, back / 2.0, own], [1.2, 0.8, rng.random_range(0.8..1.8)]);
        }
        let front = -depth / 2.0 + back / 2.0;
        let door = u + rng.random_range(-0.25..0.25) * each;
        if rng.random_bool(0.5) {
            draft.body(door, front, [2.0, back, own * rng.random_range(0.4..0.9)]);
        } else {
            draft.body(door, front, [1.4, back, 0.6]);
        }
    }
}

fn block(draft: &mut Draft, [width, depth]: [f64; 2], rng: &mut ChaCha8Rng) {
    let floors = rng.random_range(3..=6);
    let height = f64::from(floors) * 3.0 + rng.random_range(0.5..1.5);
    let bar = depth * rng.random_range(0.45..0.6);
    let bar = bar.max(8.0).min(depth - 1.2);
    // The first 1.2 m of the lot are left for balconies.
    let front = -depth / 2.0 + 1.2;
    draft.body(0.0, front + bar / 2.0, [width, bar, height]);
    let wing = (width * 0.35).min(10.0);
    let rest = depth - 1.2 - bar;
    // L, U or a T towards the court.
    let wings: &[f64] = match rng.random_range(0..4) {
        0 => &[-1.0],
        1 => &[1.0],
        2 => &[-1.0, 1.0],
        _ => &[0.0],
    };
    for side in wings {
        let lower = height - 3.0 * f64::from(rng.random_range(0..=1));
        let (u, v) = (side * (width - wing) / 2.0, front + bar + rest / 2.0);
        draft.body(u, v, [wing, rest, lower]);
    }
    for _ in 0..rng.random_range(1..=3) {
        let u = rng.random_range(-0.4..0.4) * width;
        let v = front + bar * rng.random_range(0.3..0.7);
        let size = [1.5..4.0, 1.5..3.0, 1.0..2.8].map(|range| rng.random_range(range));
        draft.block_at([u, v, height], size);
    }
    let columns = rng.random_range(2..=4);
    let balconies = rng.random_bool(0.7);
    for column in 0..columns {
        let u = width * ((f64::from(column) + 0.5) / f64::from(columns) - 0.5);
        if !balconies {
            // Stair towers or pilasters instead.
            let size = [rng.random_range(0.6..2.4), 0.6, height - 0.5];
            draft.body(u, front - 0.3, size);
            continue;
        }
        for floor in 1..floors {
            draft.block_at([u, front - 0.55, 3.0 * f64::from(floor)], [3.0, 1.1, 1.1]);
        }
    }
}

fn tower(draft: &mut Draft, [width, depth]: [f64; 2], rng: &mut ChaCha8Rng) {
    let stages = rng.random_range(2..=4);
    let (mut size, mut z) = ([width, depth], 0.0);
    let [mut u, mut v] = [0.0, 0.0];
    for stage in 0..stages {
        let height = rng.random_range(if stage == 0 { 5.0..10.0 } else { 8.0..18.0 });
        if stage == 0 {
            draft.body(u, v, [size[0], size[1], height]);
        } else {
            draft.block_at([u, v, z], [size[0], size[1], height]);
        }
        z += height;
        let next = size.map(|size| size * rng.random_range(0.6..0.9));
        // At most half of the difference: each stage stays within the one below.
        u += rng.random_range(-0.5..0.5) * (size[0] - next[0]);
        v += rng.random_range(-0.5..0.5) * (size[1] - next[1]);
        size = next;
    }
    draft.block_at([u, v, z], [size[0] * 0.4, size[1] * 0.4, 2.5]);
    draft.cylinder([u, v, z + 2.5], [0.15, rng.random_range(3.0..9.0)]);
    // An entrance hall at the foot would leave the lot; corner piers mark the front instead.
    for side in [-0.5, 0.5] {
        let size = [1.0, 1.0, rng.random_range(10.0..16.0)];
        draft.body(side * (width - 1.0), -depth / 2.0 + 0.5, size);
    }
}

fn shop(draft: &mut Draft, [width, depth]: [f64; 2], rng: &mut ChaCha8Rng) {
    let awning = 1.8;
    let height = rng.random_range(3.8..6.5);
    draft.body(0.0, awning / 2.0, [width, depth - awning, height]);
    let front = -depth / 2.0;
    let size = [width * rng.random_range(0.6..1.0), awning, 0.2];
    draft.block_at([0.0, front + awning / 2.0, 2.9], size);
    let posts = (width / 5.0).floor().max(1.0) as u32;
    for post in 0..=posts {
        let u = (f64::from(post) / f64::from(posts) - 0.5) * (width - 0.6);
        draft.cylinder([u, front + 0.3, 0.0], [0.1, 2.9]);
    }
    let u = rng.random_range(-0.3..0.3) * width;
    let sign = [rng.random_range(2.0..5.0), 0.4, rng.random_range(0.8..1.8)];
    draft.block_at([u, front + awning + 0.3, height], sign);
    if rng.random_bool(0.5) {
        let area = [width * rng.random_range(0.35..0.7), (depth - awning) * 0.8];
        let upper = [area[0], area[1], rng.random_range(2.8..6.0)];
        let u = rng.random_range(-0.5..0.5) * (width - upper[0]);
        draft.block_at([u, awning / 2.0, height], upper);
    }
    for _ in 0..rng.random_range(1..=3) {
        let u = rng.random_range(-0.4..0.4) * width;
        let v = rng.random_range(0.0..0.35) * depth;
        let size = [1.0..2.5, 1.0..2.0, 0.8..1.6].map(|range| rng.random_range(range));
        draft.block_at([u, v, height], size);
    }
}

fn hall(draft: &mut Draft, [width, depth]: [f64; 2], rng: &mut ChaCha8Rng) {
    let ramp = 2.0;
    let height = rng.random_range(5.5..9.5);
    draft.body(0.0, ramp / 2.0, [width, depth - ramp, height]);
    match rng.random_range(0..3) {
        0 => {
            let (at, rise) = ([0.0, ramp / 2.0, height], rng.random_range(1.2..2.5));
            draft.gable(at, [width, depth - ramp], rise, true);
        }
        1 => {
            // A saw-tooth roof.
            let teeth = (width / 6.0).floor().max(2.0) as u32;
            for tooth in 0..teeth {
                let u = ((f64::from(tooth) + 0.25) / f64::from(teeth) - 0.5) * width;
                let size = [width / f64::from(teeth) * 0.4, depth - ramp, 1.6];
                draft.block_at([u, ramp / 2.0, height], size);
            }
        }
        _ => {
            let size = [0.4 * width, 0.5 * depth, rng.random_range(1.5..4.0)];
            draft.block_at([0.2 * width, 0.1 * depth, height], size);
        }
    }
    let docks = rng.random_range(1..=4);
    for dock in 0..docks {
        let u = ((f64::from(dock) + 0.5) / f64::from(docks) - 0.5) * width * 0.9;
        let size = [rng.random_range(2.4..3.6), ramp, rng.random_range(0.8..3.4)];
        draft.body(u, -depth / 2.0 + ramp / 2.0, size);
    }
    if rng.random_bool(0.35) {
        let chimney = [rng.random_range(0.5..0.9), rng.random_range(14.0..26.0)];
        draft.cylinder([0.4 * width, 0.3 * depth, 0.0], chimney);
    }
}

fn church(draft: &mut Draft, [width, depth]: [f64; 2], rng: &mut ChaCha8Rng) {
    let tower = (width * 0.4).min(6.0);
    let nave = depth - tower;
    let height = rng.random_range(6.0..9.0);
    draft.body(0.0, tower / 2.0, [width * 0.75, nave, height]);
    let (at, rise) = ([0.0, tower / 2.0, height], rng.random_range(4.0..6.0));
    draft.gable(at, [width * 0.75, nave], rise, false);
    draft.body(0.0, depth * 0.15, [width, tower, height * 0.9]);
    let top = rng.random_range(14.0..22.0);
    let front = -depth / 2.0 + tower / 2.0;
    draft.body(0.0, front, [tower, tower, top]);
    for step in 0..4 {
        let side = tower * (0.85 - 0.22 * f64::from(step));
        draft.block_at([0.0, front, top + 1.5 * f64::from(step)], [side, side, 1.5]);
    }
}

fn tanks(draft: &mut Draft, [width, depth]: [f64; 2], rng: &mut ChaCha8Rng) {
    let count = rng.random_range(1..=3);
    let each = width / f64::from(count);
    for tank in 0..count {
        let u = -width / 2.0 + (f64::from(tank) + 0.5) * each;
        let radius = (each / 2.0 - 0.4).min(depth / 2.0) * rng.random_range(0.7..1.0);
        let height = rng.random_range(5.0..14.0);
        if rng.random_bool(0.25) {
            // A water tower: a tank on a stem.
            let stem = [radius * 0.35, height + FOOTING_M + 4.0];
            draft.cylinder([u, 0.0, -FOOTING_M], stem);
            draft.cylinder([u, 0.0, height + 4.0], [radius * 0.9, 5.0]);
        } else {
            draft.cylinder([u, 0.0, -FOOTING_M], [radius, height + FOOTING_M]);
            draft.cylinder([u, 0.0, height], [radius * 0.5, 1.0]);
        }
    }
}

fn petrol_station(draft: &mut Draft, [width, depth]: [f64; 2], rng: &mut ChaCha8Rng) {
    let kiosk = depth * 0.35;
    let size = [width * 0.6, kiosk, rng.random_range(3.2..4.4)];
    draft.body(0.0, (depth - kiosk) / 2.0, size);
    let (roof_width, roof_depth) = (width * 0.8, depth * 0.5);
    let v = -depth / 2.0 + roof_depth / 2.0 + 0.5;
    draft.block_at([0.0, v, 5.0], [roof_width, roof_depth, 0.9]);
    for column in [-0.35, 0.0, 0.35] {
        draft.cylinder([column * roof_width, v, 0.0], [0.25, 5.0]);
        draft.body(column * roof_width + 1.0, v, [0.6, 1.0, 1.7]);
    }
    draft.cylinder([width * 0.46, -depth / 2.0 + 0.5, 0.0], [0.18, 8.0]);
    draft.block_at([width * 0.46, -depth / 2.0 + 0.5, 6.0], [1.6, 0.4, 2.4]);
}

#[cfg(test)]
mod tests {
    use rand::SeedableRng;

    use super::super::super::curve::Pose2;
    use super::*;

    #[test]
    fn no_building_reaches_beyond_its_lot() {
        use Style::*;
        for style in [
            House,
            Row,
            Block,
            Tower,
            Shop,
            Hall,
            Church,
            Tanks,
            PetrolStation,
        ] {
            for seed in 0..60 {
                let mut rng = ChaCha8Rng::seed_from_u64(seed);
                let [width_m, depth_m] = style.lot_m(&mut rng);
                let lot = Lot {
                    foot: PartFootprint::new(Pose2::new(0.0, 0.0, 0.0), 0.0),
                    width_m,
                    depth_m,
                };
                let parts = build(style, &lot, &mut rng);
                assert!(parts.len() > 1 || style == Tanks);
                for part in parts {
                    let (low, high) = part.bounds_m();
                    let inside = low[0] >= -width_m / 2.0 - 0.35
                        && high[0] <= width_m / 2.0 + 0.35
                        && low[1] >= -depth_m / 2.0 - 0.35
                        && high[1] <= depth_m / 2.0 + 0.35;
                    assert!(
                        inside,
                        "{style:?} {seed}: {part:?} in {width_m} x {depth_m}"
                    );
                    assert!(part.shape.half_m().iter().all(|&half| half > 0.0));
                }
            }
        }
    }
}
