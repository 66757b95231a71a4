//! Terrain from roads: level or shaped to meet every road, with hills away from them, and decks where a road passes
//! above.

use super::convex::{PlanRectangle, Quad, bounds, overlap, range};
use super::ground::{Ground, HeightGrid, Terrain, Triangle};
use super::noise::hills_m;
use super::surface::{Patch, RoadSurface, cell_m, middle};

/// Distance between terrain nodes, metres; larger on maps that would need more than [`MAX_NODES`], or have very wide
/// surfaces.
const CELL_M: f64 = 2.0;
/// Most nodes of a terrain.
const MAX_NODES: f64 = 4e6;
/// Distance to which the terrain reaches beyond the roads, metres; the range of a LiDAR is 120 m, of a radar 150 m.
const MARGIN_M: f64 = 160.0;
/// Roads within this of one height lie on level ground, metres.
const LEVEL_M: f64 = 0.05;
/// A road surface this far above the terrain becomes a deck, metres.
const DECK_M: f64 = 0.12;
/// Distances from the nearest road at which hills begin and reach full height, metres.
const HILLS_FROM_M: [f64; 2] = [14.0, 90.0];
/// Roads that differ by more than this at one place pass above each other, metres.
const LEVELS_M: f32 = 0.8;
/// A road this far above another is on a bridge near it, metres.
const BRIDGE_M: f32 = 4.0;
/// Distance by which bridges reach beyond the lower road's edges, metres.
const OPENING_M: f64 = 8.0;
/// Rounds of smoothing at each level between the roads.
const SMOOTHING: usize = 12;

/// The ground under and between the roads.
pub(crate) fn ground(surface: &RoadSurface, seed: u64) -> Ground {
    let heights = surface.patches.iter().flat_map(|patch| patch.z_m);
    let [low, high] = range(heights);
    if high - low < LEVEL_M {
        return Ground::plane((low + high) / 2.0);
    }
    let mut grid = empty_grid(surface);
    let fixed = fix_under_roads(&mut grid, surface);
    fill_level(&mut grid.heights_m, &fixed, grid.columns, grid.rows);
    // Adds hills, the higher the farther from the roads.
    let distances = distances(&fixed, grid.columns, grid.rows);
    for (place, &distance) in distances.iter().enumerate() {
        let distance_m = f64::from(distance) * grid.cell_m;
        let share =
            ((distance_m - HILLS_FROM_M[0]) / (HILLS_FROM_M[1] - HILLS_FROM_M[0])).clamp(0.0, 1.0);
        let [x, y] = grid.place_m(place % grid.columns, place / grid.columns);
        // Smoothstep: hills begin and end without a kink.
        let rise_m = share * share * (3.0 - 2.0 * share) * hills_m(x, y, seed);
        grid.heights_m[place] += rise_m as f32;
    }
    let decks = decks(&grid, surface);
    let terrain = Terrain::Grid(grid);
    Ground { terrain, decks }
}

fn empty_grid(surface: &RoadSurface) -> HeightGrid {
    let [low, high] = surface.bounds_m;
    let extent = [0, 1].map(|axis| high[axis] - low[axis] + 2.0 * MARGIN_M);
    let least_m = CELL_M.max((extent[0] * extent[1] / MAX_NODES).sqrt());
    let cell_m = cell_m(&surface.patches, least_m);
    let [columns, rows] = extent.map(|extent| (extent / cell_m).ceil() as usize + 1);
    let origin_m = low.map(|low| low - MARGIN_M);
    HeightGrid {
        origin_m,
        cell_m,
        columns,
        rows,
        heights_m: vec![f32::NAN; columns * rows],
    }
}

/// Sets every node within a cell of a road to the height of the nearest road there, or of the lowest where roads pass
/// above each other; returns which are set.
fn fix_under_roads(grid: &mut HeightGrid, surface: &RoadSurface) -> Vec<bool> {
    let nodes = grid.heights_m.len();
    let (mut nearest_m, mut lowest_m) = (vec![f32::INFINITY; nodes], vec![f32::INFINITY; nodes]);
    for patch in &surface.patches {
        for (place, node) in nodes_within(grid, &patch.quad, grid.cell_m) {
            let height = patch.height_m(node) as f32;
            let distance = distance_m(node, &patch.quad) as f32;
            lowest_m[place] = lowest_m[place].min(height);
            if distance < nearest_m[place] {
                (nearest_m[place], grid.heights_m[place]) = (distance, height);
            }
        }
    }
    for (height, &lowest) in grid.heights_m.iter_mut().zip(&lowest_m) {
        // Where no road is near, the height is NaN and the comparison false.
        if *height > lowest + LEVELS_M {
            *height = lowest;
        }
    }
    // Clears nodes that an upper road has set close to a lower one, so that bridges reach beyond the lower road's
    // edges.
    for patch in &surface.patches {
        let level = patch.top_m as f32;
        for (place, _) in nodes_within(grid, &patch.quad, OPENING_M) {
            if grid.heights_m[place] > level + BRIDGE_M {
                grid.heights_m[place] = f32::NAN;
            }
        }
    }
    let heights = grid.heights_m.iter();
    heights.map(|height| !height.is_nan()).collect()
}

/// Nodes whose square of half side `reach_m` overlaps an outline, with their places in the plane.
fn nodes_within(grid: &HeightGrid, quad: &Quad, reach_m: f64) -> Vec<(usize, [f64; 2])> {
    let [low, high] = bounds(*quad);
    let [columns, rows] = [0, 1].map(|axis: usize| {
        let [first, last] = [low[axis] - reach_m, high[axis] + reach_m]
            .map(|value| ((value - grid.origin_m[axis]) / grid.cell_m).max(0.0));
        first.ceil() as usize..=last as usize
    });
    let mut nodes = Vec::new();
    for row in rows {
        for column in columns.clone() {
            let node = grid.place_m(column, row);
            if overlap(&PlanRectangle::square(node, reach_m).corners(), quad) {
                nodes.push((row * grid.columns + column, node));
            }
        }
    }
    nodes
}

/// Distance of a place from a convex outline, 0 inside, metres.
fn distance_m(place: [f64; 2], quad: &Quad) -> f64 {
    let sides = (0..4).map(|i| (quad[i], quad[(i + 1) % 4]));
    let (mut inside, mut least) = (true, f64::INFINITY);
    for (a, b) in sides {
        let (dx, dy) = (b[0] - a[0], b[1] - a[1]);
        // Corners run anticlockwise: a place inside lies to the left of every side.
        let (px, py) = (place[0] - a[0], place[1] - a[1]);
        inside &= dx * py - dy * px >= 0.0;
        let share = ((px * dx + py * dy) / (dx * dx + dy * dy).max(1e-12)).clamp(0.0, 1.0);
        least = least.min((px - share * dx).hypot(py - share * dy));
    }
    if inside { 0.0 } else { least }
}

/// Gives the nodes between the roads heights that pass smoothly from road to road: averages of ever coarser grids fill
/// what the finer ones leave open, and each level is smoothed on the way back.
fn fill_level(heights: &mut [f32], fixed: &[bool], columns: usize, rows: usize) {
    if fixed.iter().all(|&fixed| fixed) {
        return;
    }
    if columns <= 2 && rows <= 2 {
        let known = heights.iter().filter(|height| !height.is_nan());
        let mean = known.clone().sum::<f32>() / known.count().max(1) as f32;
        let open = heights.iter_mut().filter(|height| height.is_nan());
        open.for_each(|height| *height = mean);
        return;
    }
    let (half_columns, half_rows) = (columns.div_ceil(2), rows.div_ceil(2));
    let mut sums = vec![(0.0f32, 0u32); half_columns * half_rows];
    let half = |place: usize| place / columns / 2 * half_columns + place % columns / 2;
    // Open nodes are still NaN here.
    for place in (0..heights.len()).filter(|&place| fixed[place]) {
        let (sum, count) = &mut sums[half(place)];
        (*sum, *count) = (*sum + heights[place], *count + 1);
    }
    // The mean of no node is NaN: it stays open.
    let means = sums.iter().map(|&(sum, count)| sum / count as f32);
    let mut coarse: Vec<f32> = means.collect();
    let coarse_fixed: Vec<bool> = sums.iter().map(|&(_, count)| count > 0).collect();
    fill_level(&mut coarse, &coarse_fixed, half_columns, half_rows);
    for place in (0..heights.len()).filter(|&place| !fixed[place]) {
        heights[place] = coarse[half(place)];
    }
    for _ in 0..SMOOTHING {
        smooth(heights, fixed, columns, rows);
    }
}

/// One round of replacing open nodes by the mean of their four neighbours, in place, from the first to the last.
fn smooth(heights: &mut [f32], fixed: &[bool], columns: usize, rows: usize) {
    for row in 0..rows {
        for column in 0..columns {
            let place = row * columns + column;
            if fixed[place] {
                continue;
            }
            let left = heights[place - usize::from(column > 0)];
            let right = heights[place + usize::from(column + 1 < columns)];
            let below = heights[if row > 0 { place - columns } else { place }];
            let has_above = row + 1 < rows;
            let above = heights[if has_above { place + columns } else { place }];
            heights[place] = (left + right + below + above) / 4.0;
        }
    }
}

/// Distance of every node from the nearest set one, in cells: two sweeps over the neighbours (chamfer distance).
fn distances(fixed: &[bool], columns: usize, rows: usize) -> Vec<f32> {
    let mut distances: Vec<f32> = fixed
        .iter()
        .map(|&fixed| if fixed { 0.0 } else { f32::MAX / 4.0 })
        .collect();
    let nodes = (0..rows).flat_map(|row| (0..columns).map(move |column| [column, row]));
    // Step: forward sweep, from the neighbours at lower columns and rows.
    for node in nodes.clone() {
        relax(&mut distances, [columns, rows], node, -1);
    }
    // Step: backward sweep, from the neighbours at higher columns and rows.
    for node in nodes.rev() {
        relax(&mut distances, [columns, rows], node, 1);
    }
    distances
}

/// Shortens a node's distance to those over its neighbours at lower (`sign` -1) or higher (1) columns and rows.
fn relax(distances: &mut [f32], [columns, rows]: [usize; 2], [column, row]: [usize; 2], sign: i64) {
    use std::f32::consts::SQRT_2;
    let steps = [(1, 0, 1.0), (0, 1, 1.0), (1, 1, SQRT_2), (-1, 1, SQRT_2)];
    for (dx, dy, cost) in steps {
        let (x, y) = (column as i64 + sign * dx, row as i64 + sign * dy);
        if x >= 0 && y >= 0 && x < columns as i64 && y < rows as i64 {
            let near = distances[y as usize * columns + x as usize] + cost;
            let place = row * columns + column;
            distances[place] = distances[place].min(near);
        }
    }
}

/// Triangles of the road surfaces that lie above the terrain.
fn decks(grid: &HeightGrid, surface: &RoadSurface) -> Vec<Triangle> {
    let mut triangles = Vec::new();
    for patch in surface.patches.iter().filter(|patch| is_deck(patch, grid)) {
        let [a, b, c, d]: [[f64; 3]; 4] = std::array::from_fn(|corner| {
            let [x, y] = patch.quad[corner];
            [x, y, patch.z_m[corner]]
        });
        for [p, q, r] in [[a, b, c], [a, c, d]] {
            // Strips without width, or turned over in a tight bend, give no triangle.
            let area = (q[0] - p[0]) * (r[1] - p[1]) - (q[1] - p[1]) * (r[0] - p[0]);
            if area > 1e-6 {
                triangles.push([p, q, r]);
            }
        }
    }
    triangles
}

/// True if a patch lies above the terrain anywhere.
fn is_deck(patch: &Patch, grid: &HeightGrid) -> bool {
    let [a, b, c, d] = patch.quad;
    // A wide patch spans several cells of the terrain, so its corners alone do not tell.
    let middles = [(a, b), (c, d), (a, d), (b, c), (a, c)].map(|(p, q)| middle(p, q));
    let mut probes = patch.quad.into_iter().chain(middles);
    probes.any(|place| patch.height_m(place) - grid.height_m(place[0], place[1]) > DECK_M)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn level_roads_lie_on_a_plane() {
        let surface = RoadSurface::new(&super::super::layout::town1(2).network);
        assert_eq!(ground(&surface, 2), Ground::plane(0.0));
    }

    #[test]
    fn filled_heights_stay_between_the_fixed_ones_and_keep_them() {
        let (columns, rows) = (40, 30);
        let mut heights = vec![f32::NAN; columns * rows];
        for row in 0..rows {
            heights[row * columns + 3] = 0.0;
            heights[row * columns + 33] = 6.0;
        }
        let fixed: Vec<bool> = heights.iter().map(|height| !height.is_nan()).collect();
        fill_level(&mut heights, &fixed, columns, rows);
        for row in 0..rows {
            assert_eq!(
                (heights[row * columns + 3], heights[row * columns + 33]),
                (0.0, 6.0)
            );
            let middle = heights[row * columns + 18];
            assert!((2.0..4.0).contains(&middle), "{middle}");
        }
        assert!(
            heights
                .iter()
                .all(|height| (-0.001..=6.001).contains(height))
        );
    }

    #[test]
    fn wide_roads_askew_get_a_coarser_terrain() {
        let mut surface = RoadSurface::new(&super::super::layout::town1(2).network);
        assert_eq!(empty_grid(&surface).cell_m, CELL_M);
        let (right, left) = ([0.0, 0.0], [3_000.0, 3_000.0]);
        surface.patches = vec![
            Patch {
                quad: [right, right, left, left],
                z_m: [0.0; 4],
                top_m: 0.0,
                road: 0,
                carriageway: true
            };
            500
        ];
        surface.bounds_m = [right, left];
        assert!(empty_grid(&surface).cell_m > 4.0 * CELL_M);
    }

    #[test]
    fn distances_count_cells() {
        let mut fixed = vec![false; 100];
        fixed[0] = true;
        let found = distances(&fixed, 10, 10);
        assert_eq!(found[7], 7.0);
        assert!((found[99] - 9.0 * std::f32::consts::SQRT_2).abs() < 1e-4);
    }
}
