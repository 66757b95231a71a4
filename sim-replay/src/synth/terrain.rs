//! Rays against hilly ground: an exact walk over the triangles of a height grid.

use nalgebra::Vector3;

use super::cast::{BodyShape, Bounds, GROUND, Part, Surface, SurfaceRays};
use crate::town::{HeightGrid, Triangle};

/// Cells along the edge of a block, whose highest point tells whether a ray passes above all of it.
const BLOCK: i64 = 8;
/// Thickness given to road surfaces above the terrain, metres.
const DECK_M: f32 = 0.3;
/// A step across the border to the next cell, in cells.
const NUDGE: f64 = 1e-9;

/// A height grid made ready for casting.
#[derive(Debug)]
pub(crate) struct TerrainSurface {
    grid: HeightGrid,
    /// Highest node of each block, its borders included; `block_rows` rows of `block_columns`.
    highest: Vec<f64>,
    block_columns: i64,
    block_rows: i64,
    top_m: f64,
}

/// One ray in the coordinates of the grid: x and y in cells, z in metres, all growing evenly with the distance.
struct GridRay {
    origin: [f64; 2],
    slope: [f64; 2],
    z_m: f64,
    rise: f64,
}

impl TerrainSurface {
    pub(crate) fn new(grid: &HeightGrid) -> Self {
        let blocks = |nodes: usize| (nodes as i64 - 1).max(1).div_euclid(BLOCK) + 1;
        let (block_columns, block_rows) = (blocks(grid.columns), blocks(grid.rows));
        let highest = (0..block_rows * block_columns).map(|block| {
            let (column, row) = ((block % block_columns) * BLOCK, (block / block_columns) * BLOCK);
            let nodes = (0..=BLOCK).flat_map(|v| (0..=BLOCK).map(move |u| (column + u, row + v)));
            nodes.map(|(i, j)| grid.node_m(i as usize, j as usize)).fold(f64::MIN, f64::max)
        });
        let highest: Vec<f64> = highest.collect();
        let top_m = highest.iter().copied().fold(f64::MIN, f64::max);
        Self { grid: grid.clone(), highest, block_columns, block_rows, top_m }
    }

    /// Distance at which a ray meets the ground, if within `limit_m`.
    fn meet(&self, ray: &GridRay, limit_m: f64) -> Option<f64> {
        let mut at = 0.0;
        while at < limit_m {
            if ray.rise >= 0.0 && ray.z_m + ray.rise * at > self.top_m {
                return None;
            }
            let block = ray.cell(at).map(|cell| cell.div_euclid(BLOCK));
            let exit = ray.exit(block, BLOCK as f64, at).min(limit_m);
            let lowest = ray.height(at).min(ray.height(exit));
            if lowest <= self.highest_of(block)
                && let Some(hit) = self.meet_in_block(ray, at, exit)
            {
                return Some(hit);
            }
            at = exit + ray.nudge();
        }
        None
    }

    fn meet_in_block(&self, ray: &GridRay, from: f64, to: f64) -> Option<f64> {
        let mut at = from;
        while at < to {
            let cell = ray.cell(at);
            let exit = ray.exit(cell, 1.0, at).min(to);
            if let Some(hit) = self.meet_in_cell(ray, cell, at, exit) {
                return Some(hit);
            }
            at = exit + ray.nudge();
        }
        None
    }

    /// Between two distances inside one cell; on each of its two triangles the height above ground is linear.
    fn meet_in_cell(&self, ray: &GridRay, cell: [i64; 2], from: f64, to: f64) -> Option<f64> {
        let corner = |u: i64, v: i64| self.node_m(cell[0] + u, cell[1] + v);
        let (low, right, left, high) = (corner(0, 0), corner(1, 0), corner(0, 1), corner(1, 1));
        let local = |at: f64| {
            let [x, y] = ray.place(at);
            (x - cell[0] as f64, y - cell[1] as f64)
        };
        let above = |at: f64, is_right: bool| {
            let (u, v) = local(at);
            let ground = if is_right {
                low + u * (right - low) + v * (high - right)
            } else {
                low + v * (left - low) + u * (high - left)
            };
            ray.height(at) - ground
        };
        let meet = |from: f64, to: f64| {
            let (u, v) = local(0.5 * (from + to));
            let (start, end) = (above(from, u >= v), above(to, u >= v));
            (end <= 0.0 && start >= end)
                .then(|| if start <= 0.0 { from } else { from + (to - from) * start / (start - end) })
        };
        let (u, v) = local(from);
        let diagonal = from + (v - u) / off_zero(ray.slope[0] - ray.slope[1]);
        if diagonal > from && diagonal < to {
            return meet(from, diagonal).or_else(|| meet(diagonal, to));
        }
        meet(from, to)
    }

    fn highest_of(&self, [column, row]: [i64; 2]) -> f64 {
        // Beyond its edge the ground goes on at the height of the edge, which the outermost blocks hold.
        let (column, row) = (column.clamp(0, self.block_columns - 1), row.clamp(0, self.block_rows - 1));
        self.highest[(row * self.block_columns + column) as usize]
    }

    fn node_m(&self, column: i64, row: i64) -> f64 {
        self.grid.node_m(column.max(0) as usize, row.max(0) as usize)
    }
}

impl GridRay {
    fn place(&self, at: f64) -> [f64; 2] {
        std::array::from_fn(|axis| self.origin[axis] + self.slope[axis] * at)
    }

    fn cell(&self, at: f64) -> [i64; 2] {
        self.place(at).map(|place| place.floor() as i64)
    }

    fn height(&self, at: f64) -> f64 {
        self.z_m + self.rise * at
    }

    /// Where the ray leaves the square `index` of this size, at `at` or later.
    fn exit(&self, index: [i64; 2], size: f64, at: f64) -> f64 {
        let leave = |axis: usize| {
            let slope = self.slope[axis];
            let border = (index[axis] as f64 + if slope > 0.0 { 1.0 } else { 0.0 }) * size;
            if slope.abs() < 1e-12 { f64::MAX } else { (border - self.origin[axis]) / slope }
        };
        leave(0).min(leave(1)).max(at)
    }

    /// A distance that carries the ray across a border.
    fn nudge(&self) -> f64 {
        NUDGE / self.slope[0].abs().max(self.slope[1].abs()).max(1e-6)
    }
}

fn off_zero(value: f64) -> f64 {
    if value.abs() < 1e-12 { 1e-12 } else { value }
}

impl Surface for TerrainSurface {
    fn cast(&self, rays: &SurfaceRays<'_>, depth: &mut [f32], hit: &mut [u32]) {
        let cell_m = self.grid.cell_m;
        let start = [rays.origin.x - self.grid.origin_m[0], rays.origin.y - self.grid.origin_m[1]];
        for (((cos, sin), depth), hit) in rays.cos.iter().zip(rays.sin).zip(depth).zip(hit) {
            let direction: Vector3<f64> = (rays.forward * *cos + rays.up * *sin).cast();
            let ray = GridRay {
                origin: start.map(|metres| metres / cell_m),
                slope: [direction.x / cell_m, direction.y / cell_m],
                z_m: rays.origin.z,
                rise: direction.z,
            };
            if let Some(at) = self.meet(&ray, f64::from(*depth)) {
                (*depth, *hit) = (at as f32, GROUND);
            }
        }
    }
}

/// A piece of road above the terrain as a thin slab below its triangle, and its centre in the world, metres.
///
/// Returns nothing for a triangle without extent.
pub(crate) fn deck_shape(triangle: &Triangle) -> Option<(BodyShape, [f64; 3])> {
    let center: [f64; 3] = std::array::from_fn(|axis| triangle.iter().map(|corner| corner[axis]).sum::<f64>() / 3.0);
    let local = triangle.map(|corner| Vector3::from(corner) - Vector3::from(center));
    let normal = (local[1] - local[0]).cross(&(local[2] - local[0])).try_normalize(1e-9)?;
    let normal = if normal.z < 0.0 { -normal } else { normal };
    let plane = |normal: &Vector3<f64>, point: &Vector3<f64>| {
        [normal.x as f32, normal.y as f32, normal.z as f32, normal.dot(point) as f32]
    };
    let top = plane(&normal, &local[0]);
    let mut planes = vec![top, [-top[0], -top[1], -top[2], DECK_M - top[3]]];
    for (from, to, opposite) in [(0, 1, 2), (1, 2, 0), (2, 0, 1)] {
        let outward = (local[to] - local[from]).cross(&Vector3::z()).try_normalize(1e-9)?;
        let outward = if outward.dot(&(local[opposite] - local[from])) > 0.0 { -outward } else { outward };
        planes.push(plane(&outward, &local[from]));
    }
    let corners = local.map(|corner| corner.map(|metres| metres as f32));
    let mut bounds = corners.iter().fold(Bounds { min_m: [f32::MAX; 3], max_m: [f32::MIN; 3] }, |bounds, corner| {
        bounds.union(&Bounds { min_m: (*corner).into(), max_m: (*corner).into() })
    });
    // Below a steep face the slab reaches a little deeper than its thickness.
    bounds.min_m[2] -= DECK_M / (normal.z as f32).max(0.2);
    Some((BodyShape::new(vec![Part::Hull { planes, bounds }], 0.25), center))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::synth::cast::{Body, Caster, Placement, Plane, RayPattern, Sweep};
    use crate::synth::random::SplitMix64;

    fn hills(seed: u64) -> HeightGrid {
        let mut random = SplitMix64::new(seed);
        let (columns, rows) = (37, 29);
        let mut heights_m = vec![0.0f32; columns * rows];
        for _ in 0..25 {
            let (x, y) = (random.between(0.0, 37.0), random.between(0.0, 29.0));
            let (height, width) = (random.between(-2.0, 5.0), random.between(1.5, 6.0));
            for (node, value) in heights_m.iter_mut().enumerate() {
                let (dx, dy) = ((node % columns) as f64 - x, (node / columns) as f64 - y);
                *value += (height * (-(dx * dx + dy * dy) / (width * width)).exp()) as f32;
            }
        }
        HeightGrid { origin_m: [-70.0, -55.0], cell_m: 4.0, columns, rows, heights_m }
    }

    #[test]
    fn rays_meet_hills_where_small_steps_do() {
        let mut random = SplitMix64::new(17);
        let mut met = 0;
        for seed in 0..10 {
            let grid = hills(seed);
            let surface = TerrainSurface::new(&grid);
            for _ in 0..60 {
                let (x, y) = (random.between(-90.0, 90.0), random.between(-75.0, 75.0));
                let origin = Vector3::new(x, y, grid.height_m(x, y) + random.between(0.5, 4.0));
                let yaw = random.between(-3.2, 3.2);
                let forward = Vector3::new(yaw.cos(), yaw.sin(), 0.0).cast::<f32>();
                let elevation = random.between(-0.4, 0.1) as f32;
                let (cos, sin) = ([elevation.cos()], [elevation.sin()]);
                let rays = SurfaceRays { origin, forward, up: Vector3::z(), cos: &cos, sin: &sin };
                let (mut depth, mut hit) = ([120.0f32], [0]);
                surface.cast(&rays, &mut depth, &mut hit);

                let direction: Vector3<f64> = (forward * cos[0] + Vector3::z() * sin[0]).cast();
                let below = |at: f64| {
                    let point = origin + direction * at;
                    point.z <= grid.height_m(point.x, point.y)
                };
                let expected = (1..24_000).map(|step| 0.005 * f64::from(step)).find(|&at| below(at));
                match expected {
                    Some(at) => assert!((at - f64::from(depth[0])).abs() < 0.011, "{at} {depth:?}"),
                    None => assert_eq!(hit[0], 0, "{depth:?}"),
                }
                met += usize::from(expected.is_some());
            }
        }
        assert!(met > 200, "{met}");
    }

    #[test]
    fn a_deck_is_seen_from_above_and_from_below() {
        let square: [Triangle; 2] = [
            [[10.0, -6.0, 5.0], [22.0, -6.0, 5.0], [22.0, 6.0, 5.0]],
            [[10.0, -6.0, 5.0], [22.0, 6.0, 5.0], [10.0, 6.0, 5.0]],
        ];
        let shapes = square.map(|triangle| deck_shape(&triangle).unwrap());
        let bodies = [0, 1].map(|index: usize| {
            let (shape, center) = &shapes[index];
            Body { shape, motion: Sweep::still(Placement::level(*center, 0.0)) }
        });
        let pattern = RayPattern {
            first_azimuth_rad: -0.1,
            azimuth_step_rad: 0.02,
            columns: 11,
            first_elevation_rad: -0.3,
            elevation_step_rad: 0.02,
            channels: 31,
            range_m: 100.0,
            rolling: false,
        };
        let mut caster = Caster::new(pattern.clone());
        for (height, deck_z) in [(9.0, 5.0), (2.0, 5.0 - f64::from(DECK_M))] {
            let sensor = Sweep::still(Placement::level([0.0, 0.0, height], 0.0));
            let image = caster.cast(&sensor, &Plane(-50.0), &bodies);
            for channel in 0..31 {
                let elevation = f64::from(pattern.elevation_rad(channel));
                let at = (deck_z - height) / elevation.sin();
                let x = at * elevation.cos();
                // Clear of the border and of its upright side.
                if at > 0.0 && (11.0..21.0).contains(&x) {
                    let depth = f64::from(image.depths_m[5 * 31 + channel]);
                    assert!((depth - at).abs() < 1e-3, "{height}: {depth} {at}");
                }
            }
        }
    }
}
