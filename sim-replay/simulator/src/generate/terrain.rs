//! Ray casting on hilly ground: exact traversal of the triangles of a height grid.
//!
//! The rays of a column pass over the same strip of ground, the higher ones above the lower ones. Where the lower ray
//! was clear of everything around the strip, the higher one is too, and its traversal begins farther out.

use nalgebra::Vector3;

use super::raycast::{Bounds, Convex, GROUND, SolidShape, Surface, SurfaceRays};
use crate::map::{HeightGrid, Triangle};

/// Length of the pieces of the strip under a column, metres.
const PIECE_M: f64 = 4.0;
/// The maximum height of the ground is known at least this far around every position, metres.
const AROUND_M: f64 = 8.0;
/// Steepest ray (tangent of the elevation), which bounds how far a tilted sensor's rays leave the strip.
const STEEPEST: f64 = 0.6;
/// Thickness given to road surfaces above the terrain, metres.
const DECK_M: f32 = 0.3;

/// A height grid prepared for ray casting.
#[derive(Debug)]
pub(crate) struct TerrainSurface {
    grid: HeightGrid,
    /// Highest corner of each cell, metres.
    cell_tops: Tops,
    /// Highest node within at least [`AROUND_M`] of each place, metres.
    wide_tops: Tops,
}

/// One number for each square of some cells of the grid.
#[derive(Debug)]
struct Tops {
    cells: f64,
    columns: i64,
    rows: i64,
    values: Vec<f64>,
}

/// One ray in the coordinates of the grid: x and y in cells, z in metres, all growing evenly with the distance.
struct GridRay {
    origin: [f64; 2],
    slope: [f64; 2],
    z_m: f64,
    rise: f64,
}

impl Tops {
    /// The highest node of each square of `cells` cells, its borders included.
    fn of_squares(grid: &HeightGrid, cells: usize) -> Self {
        let [columns, rows] =
            [grid.columns, grid.rows].map(|nodes| (nodes - 1).div_ceil(cells).max(1));
        let values = (0..columns * rows).map(|square| {
            let (column, row) = (square % columns * cells, square / columns * cells);
            let nodes = (0..=cells).flat_map(|v| (0..=cells).map(move |u| (column + u, row + v)));
            let heights = nodes.map(|(i, j)| grid.node_m(i, j));
            heights.fold(f64::MIN, f64::max)
        });
        Self {
            cells: cells as f64,
            columns: columns as i64,
            rows: rows as i64,
            values: values.collect(),
        }
    }

    /// The highest of each square and the eight around it.
    fn widened(&self) -> Self {
        let values = (0..self.columns * self.rows).map(|square| {
            let (column, row) = (square % self.columns, square / self.columns);
            let squares = (-1..=1).flat_map(|v| (-1..=1).map(move |u| (column + u, row + v)));
            let heights = squares.map(|(column, row)| self.at(column, row));
            heights.fold(f64::MIN, f64::max)
        });
        Self {
            values: values.collect(),
            ..*self
        }
    }

    /// Beyond its edge the ground goes on at the height of the edge, which the outermost squares hold.
    fn at(&self, column: i64, row: i64) -> f64 {
        let column = column.clamp(0, self.columns - 1);
        let row = row.clamp(0, self.rows - 1);
        self.values[(row * self.columns + column) as usize]
    }

    /// The square under a place given in cells.
    fn under(&self, [x, y]: [f64; 2]) -> f64 {
        let [column, row] = [x, y].map(|place| (place / self.cells).floor() as i64);
        self.at(column, row)
    }
}

impl TerrainSurface {
    pub(crate) fn new(grid: &HeightGrid) -> Self {
        // With the eight around it, a square of this size covers AROUND_M around any place in it.
        let wide = (AROUND_M / grid.cell_m).ceil().max(1.0) as usize;
        Self {
            cell_tops: Tops::of_squares(grid, 1),
            wide_tops: Tops::of_squares(grid, wide).widened(),
            grid: grid.clone(),
        }
    }

    /// Distance at which a ray meets the ground between two distances.
    fn meet(&self, ray: &GridRay, from_m: f64, limit_m: f64) -> Option<f64> {
        let mut cell = ray.place(from_m).map(|place| place.floor() as i64);
        let inverse = ray.slope.map(|slope| 1.0 / slope);
        // The ray visits cell after cell; the nearer border gives the next one.
        let mut leaves = [0, 1].map(|axis| ray.leave(axis, cell[axis], inverse[axis]));
        let mut at = from_m;
        loop {
            let axis = usize::from(leaves[1] < leaves[0]);
            // Rounding may put the border slightly behind the ray.
            let exit = leaves[axis].max(at).min(limit_m);
            // The ray is straight, so its lowest place in the cell is one of the two ends.
            if ray.height(at).min(ray.height(exit)) <= self.cell_tops.at(cell[0], cell[1])
                && let Some(hit) = self.meet_in_cell(ray, cell, at, exit)
            {
                return Some(hit);
            }
            if exit >= limit_m {
                return None;
            }
            cell[axis] += if ray.slope[axis] > 0.0 { 1 } else { -1 };
            leaves[axis] = ray.leave(axis, cell[axis], inverse[axis]);
            at = exit;
        }
    }

    /// Between two distances inside one cell; on each of its two triangles the height above ground is linear.
    fn meet_in_cell(&self, ray: &GridRay, cell: [i64; 2], from: f64, to: f64) -> Option<f64> {
        let [low, right, left, high] = [(0, 0), (1, 0), (0, 1), (1, 1)].map(|(u, v)| {
            // Beyond the edge the height of the edge holds. The grid clamps the upper end itself.
            let [column, row] = [cell[0] + u, cell[1] + v].map(|place: i64| place.max(0) as usize);
            self.grid.node_m(column, row)
        });
        let [u, v] = ray.within(cell, from);
        // The diagonal of a cell separates its two triangles.
        let slope = ray.slope[0] - ray.slope[1];
        let slope = if slope.abs() < 1e-12 { 1e-12 } else { slope };
        let diagonal = from + (v - u) / slope;
        let pieces: &[[f64; 2]] = if diagonal > from && diagonal < to {
            &[[from, diagonal], [diagonal, to]]
        } else {
            &[[from, to]]
        };
        pieces.iter().find_map(|&[from, to]| {
            // The middle decides on the triangle, since either end may lie on the diagonal.
            let [u, v] = ray.within(cell, 0.5 * (from + to));
            let is_right = u >= v;
            let [start, end] = [from, to].map(|at| {
                let [u, v] = ray.within(cell, at);
                let ground = match is_right {
                    true => low + u * (right - low) + v * (high - right),
                    false => low + v * (left - low) + u * (high - left),
                };
                ray.height(at) - ground
            });
            // Rays that come out of the ground from below do not hit it.
            (end <= 0.0 && start >= end).then(|| {
                // Already below at its start: the seam between two pieces leaves no gap.
                if start <= 0.0 {
                    from
                } else {
                    from + (to - from) * start / (start - end)
                }
            })
        })
    }
}

impl GridRay {
    fn place(&self, at: f64) -> [f64; 2] {
        std::array::from_fn(|axis| self.origin[axis] + self.slope[axis] * at)
    }

    /// The place in a cell.
    fn within(&self, cell: [i64; 2], at: f64) -> [f64; 2] {
        let [x, y] = self.place(at);
        [x - cell[0] as f64, y - cell[1] as f64]
    }

    /// Place along the ray at which it leaves a cell in the direction of `axis`; `inverse`: 1 / slope of that axis.
    fn leave(&self, axis: usize, cell: i64, inverse: f64) -> f64 {
        let border = (cell + i64::from(self.slope[axis] > 0.0)) as f64;
        let at = (border - self.origin[axis]) * inverse;
        // Along the other axis no border is ever reached.
        if inverse.is_finite() { at } else { f64::MAX }
    }

    fn height(&self, at: f64) -> f64 {
        self.z_m + self.rise * at
    }
}

impl Surface for TerrainSurface {
    /// The elevations must grow from ray to ray, as they do in every column of a caster.
    fn cast(&self, rays: &SurfaceRays<'_>, depth: &mut [f32], hit: &mut [u32]) {
        let cell_m = self.grid.cell_m;
        let [x, y] = self.grid.origin_m;
        let origin = [rays.origin.x - x, rays.origin.y - y].map(|metres| metres / cell_m);
        // The ground is cast before all bodies, so the depths still are the range of the sensor.
        let range_m = depth.iter().copied().fold(0.0, f32::max);
        let mut strip = GroundStrip::new(self, rays, origin, f64::from(range_m));
        for (((cos, sin), depth), hit) in rays.cos.iter().zip(rays.sin).zip(depth).zip(hit) {
            let direction: Vector3<f64> = (rays.forward * *cos + rays.up * *sin).cast();
            let slope = [direction.x / cell_m, direction.y / cell_m];
            let ray = GridRay {
                origin,
                slope,
                z_m: rays.origin.z,
                rise: direction.z,
            };
            let Some(from_m) = strip.clear_m(&ray, direction.xy().norm()) else {
                return;
            };
            if let Some(at) = self.meet(&ray, from_m, f64::from(*depth)) {
                (*depth, *hit) = (at as f32, GROUND);
            }
        }
    }
}

/// The ground under a column, up to the distance at which its lower rays are known to be clear.
struct GroundStrip<'a> {
    surface: &'a TerrainSurface,
    origin: [f64; 2],
    /// Cells for each metre along the strip.
    step: [f64; 2],
    pieces: usize,
    /// Pieces that are clear, and the top of the next one.
    clear: usize,
    top_m: f64,
    /// True if all rays stay where the maximum heights are known.
    is_narrow: bool,
}

impl<'a> GroundStrip<'a> {
    fn new(
        surface: &'a TerrainSurface,
        rays: &SurfaceRays<'_>,
        origin: [f64; 2],
        range_m: f64,
    ) -> Self {
        let along: Vector3<f64> = rays.forward.cast();
        let step = along.xy() / along.xy().norm().max(1e-6) / surface.grid.cell_m;
        let tilt = f64::from(rays.up.xy().norm());
        // Half a piece, and the sideways drift of the steepest ray of a tilted sensor over the range.
        let aside_m = 0.5 * PIECE_M + range_m * tilt * STEEPEST;
        let mut angles = rays.sin.iter().zip(rays.cos);
        let is_steep = angles.any(|(sin, cos)| f64::from(sin.abs()) > STEEPEST * f64::from(*cos));
        let mut strip = Self {
            surface,
            origin,
            step: step.into(),
            pieces: (range_m / PIECE_M).ceil() as usize,
            clear: 0,
            top_m: f64::MAX,
            is_narrow: aside_m < 0.95 * AROUND_M && !is_steep,
        };
        strip.top_m = strip.next_top_m();
        strip
    }

    /// The distance up to which a ray is clear of the ground; `None` if it is clear over its whole length, and then the
    /// rays above it are too. `flat` is the share of the distance along the ground.
    fn clear_m(&mut self, ray: &GridRay, flat: f64) -> Option<f64> {
        // Rays that leave the strip could meet ground that the strip does not know.
        if !self.is_narrow || flat < 1e-3 {
            return Some(0.0);
        }
        let rise = ray.rise / flat;
        while self.clear < self.pieces {
            let near_m = self.clear as f64 * PIECE_M;
            if (ray.z_m + rise * near_m).min(ray.z_m + rise * (near_m + PIECE_M)) <= self.top_m {
                return Some(near_m / flat);
            }
            self.clear += 1;
            self.top_m = self.next_top_m();
        }
        None
    }

    fn next_top_m(&self) -> f64 {
        let middle_m = (self.clear as f64 + 0.5) * PIECE_M;
        self.surface.wide_tops.under(std::array::from_fn(|axis| {
            self.origin[axis] + self.step[axis] * middle_m
        }))
    }
}

/// A piece of road above the terrain as a thin slab below its triangle, and its centre in the world, metres.
///
/// Returns nothing for a triangle without extent.
pub(crate) fn deck_shape(triangle: &Triangle) -> Option<(SolidShape, [f64; 3])> {
    let center: [f64; 3] =
        std::array::from_fn(|axis| triangle.iter().map(|corner| corner[axis]).sum::<f64>() / 3.0);
    let local = triangle.map(|corner| Vector3::from(corner) - Vector3::from(center));
    let normal = (local[1] - local[0])
        .cross(&(local[2] - local[0]))
        .try_normalize(1e-9)?;
    // The top of a deck faces up, whatever the order of its corners.
    let normal = if normal.z < 0.0 { -normal } else { normal };
    let top = plane(&normal, &local[0]);
    // The second plane is the underside, DECK_M below the top.
    let mut planes = vec![top, [-top[0], -top[1], -top[2], DECK_M - top[3]]];
    for (from, to, opposite) in [(0, 1, 2), (1, 2, 0), (2, 0, 1)] {
        let outward = (local[to] - local[from])
            .cross(&Vector3::z())
            .try_normalize(1e-9)?;
        let is_inward = outward.dot(&(local[opposite] - local[from])) > 0.0;
        let outward = if is_inward { -outward } else { outward };
        planes.push(plane(&outward, &local[from]));
    }
    let corners = local.map(|corner| corner.map(|metres| metres as f32));
    let [a, b, c] = corners.map(|corner| Bounds::centered(corner.into(), [0.0; 3]));
    let mut bounds = a.union(&b).union(&c);
    // Below a steep face the slab reaches a little deeper than its thickness.
    bounds.min_m[2] -= DECK_M / (normal.z as f32).max(0.2);
    let shape = SolidShape::new(vec![Convex::Hull { planes, bounds }], 0.25);
    Some((shape, center))
}

fn plane(normal: &Vector3<f64>, point: &Vector3<f64>) -> [f32; 4] {
    let [x, y, z]: [f32; 3] = normal.map(|part| part as f32).into();
    [x, y, z, normal.dot(point) as f32]
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::generate::raycast::{Caster, Course, Placement, Plane, RayBody, RayPattern};
    use support::random::SplitMix64;

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
        HeightGrid {
            origin_m: [-70.0, -55.0],
            cell_m: 4.0,
            columns,
            rows,
            heights_m,
        }
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
                let rays = SurfaceRays {
                    origin,
                    forward,
                    up: Vector3::z(),
                    cos: &cos,
                    sin: &sin,
                };
                let (mut depth, mut hit) = ([120.0f32], [0]);
                surface.cast(&rays, &mut depth, &mut hit);

                let direction: Vector3<f64> = (forward * cos[0] + Vector3::z() * sin[0]).cast();
                let expected = (1..24_000).map(|step| 0.005 * f64::from(step)).find(|&at| {
                    let point = origin + direction * at;
                    point.z <= grid.height_m(point.x, point.y)
                });
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
    fn columns_of_a_tilted_sensor_hit_the_same_as_single_rays() {
        let mut random = SplitMix64::new(23);
        let elevations: Vec<f32> = (0..64)
            .map(|channel| (-25.0 + 27.0 / 63.0 * channel as f32).to_radians())
            .collect();
        let cos: Vec<f32> = elevations.iter().map(|elevation| elevation.cos()).collect();
        let sin: Vec<f32> = elevations.iter().map(|elevation| elevation.sin()).collect();
        for seed in 0..20 {
            let grid = hills(100 + seed);
            let surface = TerrainSurface::new(&grid);
            for _ in 0..40 {
                let (x, y) = (random.between(-60.0, 60.0), random.between(-45.0, 45.0));
                let place = Placement {
                    position_m: Vector3::new(x, y, grid.height_m(x, y) + 1.95),
                    yaw_rad: random.between(-3.2, 3.2),
                    pitch_rad: random.between(-0.12, 0.12),
                    roll_rad: random.between(-0.12, 0.12),
                };
                let azimuth = random.between(-3.2, 3.2);
                let forward =
                    (place.rotation() * Vector3::new(azimuth.cos(), azimuth.sin(), 0.0)).cast();
                let up = (place.rotation() * Vector3::z()).cast();
                let rays = SurfaceRays {
                    origin: place.position_m,
                    forward,
                    up,
                    cos: &cos,
                    sin: &sin,
                };
                let (mut depth, mut hit) = ([120.0f32; 64], [0; 64]);
                surface.cast(&rays, &mut depth, &mut hit);
                for ray in 0..64 {
                    let (mut lone_depth, mut lone_hit) = ([120.0f32], [0]);
                    let direction: Vector3<f64> = (forward * cos[ray] + up * sin[ray]).cast();
                    let slope = [direction.x / grid.cell_m, direction.y / grid.cell_m];
                    let origin = [0, 1].map(|axis: usize| {
                        (place.position_m[axis] - grid.origin_m[axis]) / grid.cell_m
                    });
                    let whole = GridRay {
                        origin,
                        slope,
                        z_m: place.position_m.z,
                        rise: direction.z,
                    };
                    if let Some(at) = surface.meet(&whole, 0.0, 120.0) {
                        (lone_depth[0], lone_hit[0]) = (at as f32, GROUND);
                    }
                    assert!(hit[ray] == lone_hit[0] && (depth[ray] - lone_depth[0]).abs() < 1e-4);
                }
            }
        }
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
            RayBody {
                shape,
                motion: Course::still(Placement::level(*center, 0.0)),
            }
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
            let sensor = Course::still(Placement::level([0.0, 0.0, height], 0.0));
            caster.cast(&sensor, &Plane(-50.0), &bodies);
            let image = &caster.image;
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
