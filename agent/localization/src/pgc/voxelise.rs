//! Voxels, cells and rulebooks of the convolutions of a sweep: everything that needs no tensors.

use super::encoder_config::{SceneEncoderConfig, VoxelInput};
use perception::sparse::{Rulebook, Sites};

/// Units of coordinates that enter a network, metres.
const INPUT_SCALE_M: f32 = 10.0;

/// A part of the sweep that a scene coordinate is regressed for.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct SweepCell {
    /// Mean of its points, metres in the sensor frame.
    pub centroid_m: [f32; 3],
    /// Highest minus lowest point, metres.
    pub extent_m: f32,
    /// Number of its points.
    pub points: u32,
}

impl SweepCell {
    /// Height below which cells look the same everywhere, metres.
    const FLAT_M: f32 = 0.3;

    /// True if it is flat ground, by its height.
    pub fn is_flat(&self) -> bool {
        self.extent_m < Self::FLAT_M
    }
}

/// Sums over the points of a cell.
#[derive(Debug, Clone, Copy)]
pub(super) struct CellPoints {
    sum_m: [f32; 3],
    low_m: f32,
    high_m: f32,
    pub(super) count: u32,
}

impl CellPoints {
    pub(super) const NONE: Self = Self {
        sum_m: [0.0; 3],
        low_m: f32::MAX,
        high_m: f32::MIN,
        count: 0,
    };

    pub(super) fn add(&mut self, point_m: [f32; 3]) {
        (0..3).for_each(|axis| self.sum_m[axis] += point_m[axis]);
        self.low_m = self.low_m.min(point_m[2]);
        self.high_m = self.high_m.max(point_m[2]);
        self.count += 1;
    }

    pub(super) fn cell(&self) -> SweepCell {
        SweepCell {
            centroid_m: self.sum_m.map(|sum| sum / self.count as f32),
            extent_m: self.high_m - self.low_m,
            points: self.count,
        }
    }
}

/// One sweep, ready for the encoder.
#[derive(Debug, Clone)]
pub struct SweepVoxels {
    /// `[N, C]` input features of voxels.
    pub(super) input: Vec<f32>,
    /// Stride 1 on the voxels.
    pub(super) first: Rulebook,
    /// Stride 2 from each level to the next.
    pub(super) down: Vec<Rulebook>,
    /// Stride 1 on the level before the last, where cells are fine.
    pub(super) fine: Option<Rulebook>,
    /// Stride 1 on the last level.
    pub(super) coarse: Rulebook,
    /// For each cell the row of the last level that it lies in.
    pub(super) coarse_of_cell: Vec<u32>,
    /// For each row of the last level its column in the plane, `y * edge + x`.
    pub(super) columns: Vec<u32>,
    /// The cells.
    pub(super) cells: Vec<SweepCell>,
}

impl SweepVoxels {
    /// Sorts points `[N]` of x, y, z (metres, sensor frame) into voxels; those out of range or not finite are left out.
    pub fn new(points: impl IntoIterator<Item = [f32; 3]>, config: &SceneEncoderConfig) -> Self {
        let inside = points.into_iter().filter(|point| is_inside(point, config));
        let points: Vec<[f32; 3]> = inside.collect();
        let voxel_m = config.voxel_m as f32;
        let voxels = points.iter().map(|point| {
            // Rounded down: a cast alone would merge the voxels on both sides of 0.
            point.map(|axis| (axis / voxel_m).floor() as i32)
        });
        let (voxels, voxel_of_point) = Sites::collect(voxels);
        let input = describe(&points, &voxel_of_point, &voxels, config);

        let first = Rulebook::submanifold(&voxels);
        let mut down = Vec::new();
        let mut fine = None;
        let mut coarse_of_cell = Vec::new();
        let mut cell_of_point = voxel_of_point;
        let cell_level = config.levels() - 1 - usize::from(config.fine_cells);
        let mut sites = voxels;
        for level in 1..config.levels() {
            let (halved, parents) = sites.halved();
            down.push(Rulebook::strided(&sites, &halved));
            if level <= cell_level {
                cell_of_point
                    .iter_mut()
                    .for_each(|row| *row = parents[*row as usize]);
            } else {
                fine = Some(Rulebook::submanifold(&sites));
                coarse_of_cell = parents;
            }
            sites = halved;
        }
        if !config.fine_cells {
            coarse_of_cell = (0..sites.len() as u32).collect();
        }
        Self {
            input,
            first,
            down,
            fine,
            coarse: Rulebook::submanifold(&sites),
            cells: cells(&points, &cell_of_point, coarse_of_cell.len()),
            coarse_of_cell,
            columns: columns(&sites, config),
        }
    }

    /// The cells, in the order of the encoder's rows.
    pub fn cells(&self) -> &[SweepCell] {
        &self.cells
    }
}

/// Edge of the square of coarse cells that a sweep lies in.
pub(super) fn plane_edge(config: &SceneEncoderConfig) -> i32 {
    // One cell of margin: a point exactly at the range lies in the next one.
    2 * ((config.range_m / config.coarse_cell_m()).ceil() as i32 + 1)
}

fn is_inside([x, y, z]: &[f32; 3], config: &SceneEncoderConfig) -> bool {
    // Comparisons with NaN are false.
    f64::from(x * x + y * y) <= config.range_m * config.range_m
        && f64::from(*z) >= config.height_m[0]
        && f64::from(*z) <= config.height_m[1]
}

fn describe(
    points: &[[f32; 3]],
    rows: &[u32],
    voxels: &Sites,
    config: &SceneEncoderConfig,
) -> Vec<f32> {
    let voxel_m = config.voxel_m as f32;
    let mut input = Vec::with_capacity(voxels.len() * config.input.channels() as usize);
    let cells = cells(points, rows, voxels.len());
    for (cell, coord) in cells.iter().zip(voxels.coords()) {
        let mean = cell.centroid_m;
        match config.input {
            VoxelInput::Coordinates => input.extend(mean.map(|axis| axis / INPUT_SCALE_M)),
            VoxelInput::Offsets => {
                input.extend((0..3).map(|axis| mean[axis] / voxel_m - coord[axis] as f32 - 0.5));
                input.extend([mean[2] / INPUT_SCALE_M, 1.0]);
            }
        }
    }
    input
}

fn cells(points: &[[f32; 3]], rows: &[u32], count: usize) -> Vec<SweepCell> {
    let mut cells = vec![CellPoints::NONE; count];
    for (point, &row) in points.iter().zip(rows) {
        cells[row as usize].add(*point);
    }
    cells.iter().map(CellPoints::cell).collect()
}

fn columns(sites: &Sites, config: &SceneEncoderConfig) -> Vec<u32> {
    let edge = plane_edge(config);
    let coords = sites.coords().iter();
    let columns = coords.map(|&[x, y, _]| ((y + edge / 2) * edge + x + edge / 2) as u32);
    columns.collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn wall() -> Vec<[f32; 3]> {
        (0..4000)
            .map(|k| {
                [
                    (k % 50) as f32 * 0.2 + 3.0,
                    5.1,
                    (k / 50) as f32 * 0.05 - 1.5,
                ]
            })
            .collect()
    }

    #[test]
    fn cells_hold_all_points_that_are_in_range() {
        for config in [SceneEncoderConfig::lean(), SceneEncoderConfig::full(0.5)] {
            let mut points = wall();
            let count = points.len() as u32;
            points.extend([
                [f32::NAN, 0.0, 0.0],
                [500.0, 0.0, 0.0],
                [1.0, 1.0, f32::INFINITY],
                [1.0, 1.0, -50.0],
            ]);
            let sweep = SweepVoxels::new(points, &config);
            assert_eq!(
                sweep.cells().iter().map(|cell| cell.points).sum::<u32>(),
                count
            );
            let share = if config.fine_cells { 0.5 } else { 1.0 };
            let half = (share * config.coarse_cell_m()) as f32;
            assert!(
                sweep
                    .cells()
                    .iter()
                    .all(|cell| cell.extent_m <= half && (cell.centroid_m[1] - 5.1).abs() < 1e-3)
            );
            assert_eq!(sweep.coarse_of_cell.len(), sweep.cells.len());
            assert!(
                sweep
                    .coarse_of_cell
                    .iter()
                    .all(|&row| (row as usize) < sweep.columns.len())
            );
            assert_eq!(
                sweep.input.len(),
                sweep.first.outputs() * config.input.channels() as usize
            );
            let edge = plane_edge(&config);
            assert!(
                sweep
                    .columns
                    .iter()
                    .all(|&column| column < (edge * edge) as u32)
            );
        }
    }

    #[test]
    fn a_cell_has_the_mean_of_its_points() {
        let points = [[10.1, 0.3, 0.2], [10.3, 0.5, 1.2]];
        let sweep = SweepVoxels::new(points, &SceneEncoderConfig::lean());
        let [cell] = sweep.cells() else {
            panic!("{:?}", sweep.cells())
        };
        assert!((cell.centroid_m[0] - 10.2).abs() < 1e-5 && (cell.extent_m - 1.0).abs() < 1e-5);
    }

    #[test]
    fn an_empty_sweep_has_no_voxels() {
        let sweep = SweepVoxels::new([], &SceneEncoderConfig::lean());
        assert!(sweep.cells().is_empty() && sweep.first.outputs() == 0);
    }
}
