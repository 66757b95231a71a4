//! BEV cells of a sweep: its occupied cells on the finest level of a detector's backbone.

use perception::crop::Crop;
use perception::model_config::{DetectorConfig, YAxis};
use protocol::PointCloud;

use crate::pgc::voxelise::{CellPoints, SweepCell};

/// Edges of the surroundings of a cell, whose mean features are added to its own, metres; as those of the scene encoder.
const CONTEXT_M: [f64; 2] = [20.0, 60.0];

/// Grids of a detector's backbone.
#[derive(Debug, Clone, PartialEq)]
pub struct BevFormat {
    crop: Crop,
    /// x, y of the grids' lower corner in the network's frame, metres.
    low_m: [f32; 2],
    /// Largest horizontal distance in the detector's area, metres.
    pub(super) range_m: f64,
    /// -1 if the network's y axis points to the right.
    y_sign: f32,
    levels: Vec<LevelGrid>,
}

/// Grid of one level.
#[derive(Debug, Clone, Copy, PartialEq)]
struct LevelGrid {
    channels: i64,
    /// Edge of a cell, metres.
    cell_m: [f32; 2],
    /// Columns and rows.
    size: [usize; 2],
}

/// Occupied cells of one sweep.
#[derive(Debug, Clone)]
pub struct BevCells {
    pub(super) cells: Vec<SweepCell>,
    /// For each level the number of the cell that contains each of [`Self::cells`], `y * width + x`.
    pub(super) places: Vec<Vec<i64>>,
    /// Points in the detector's area.
    pub(super) cloud: PointCloud,
}

impl BevFormat {
    /// The grids of a detector.
    pub fn of_detector(config: &DetectorConfig) -> Self {
        let [columns, rows, _] = config.pillar_grid();
        let mut stride = 1;
        let levels = config.num_filters.iter().zip(&config.layer_strides);
        let levels = levels.map(|(&channels, &step)| {
            stride *= step;
            LevelGrid {
                channels,
                cell_m: [0, 1].map(|axis| (config.voxel_size_m[axis] * stride as f64) as f32),
                size: [columns, rows].map(|pillars| pillars.div_ceil(stride as usize)),
            }
        });
        let is_right = config.y_axis == YAxis::Right;
        let range_m = config.lidar_range_m.map(f64::abs);
        let [x_m, y_m] = [0, 1].map(|axis| range_m[axis].max(range_m[axis + 3]));
        Self {
            crop: Crop::for_detector(config),
            low_m: [0, 1].map(|axis| config.lidar_range_m[axis] as f32),
            range_m: x_m.hypot(y_m),
            y_sign: if is_right { -1.0 } else { 1.0 },
            levels: levels.collect(),
        }
    }

    pub(super) fn local_channels(&self) -> i64 {
        self.levels.iter().map(|level| level.channels).sum()
    }

    pub(super) fn cell_channels(&self) -> i64 {
        self.local_channels() + CONTEXT_M.len() as i64 * self.coarse_channels()
    }

    pub(super) fn sweep_channels(&self) -> i64 {
        2 * self.coarse_channels()
    }

    /// Channels, height and width of each level.
    pub(super) fn shapes(&self) -> impl Iterator<Item = [i64; 3]> + '_ {
        let levels = self.levels.iter();
        levels.map(|level| [level.channels, level.size[1] as i64, level.size[0] as i64])
    }

    /// Height and width of the surroundings of a cell, cells of the coarsest level; odd, so that the cell is in the
    /// centre.
    pub(super) fn windows(&self) -> impl Iterator<Item = [i64; 2]> + '_ {
        let cell_m = self.levels.last().map_or([1.0; 2], |level| level.cell_m);
        CONTEXT_M.into_iter().map(move |edge_m| {
            // Height first: maps are `[.., H, W]`, and y is along H.
            [1, 0].map(|axis| 2 * (edge_m / f64::from(cell_m[axis]) / 2.0).round() as i64 + 1)
        })
    }

    fn coarse_channels(&self) -> i64 {
        self.levels.last().map_or(0, |level| level.channels)
    }
}

impl LevelGrid {
    /// Column and row of the cell under a place (metres from the grid's corner); the last where rounding leads beyond.
    fn cell(&self, place_m: [f32; 2]) -> [usize; 2] {
        // The cast saturates: a place that rounding leaves below the corner is in cell 0.
        let cell = [0, 1].map(|axis| (place_m[axis] / self.cell_m[axis]) as usize);
        [0, 1].map(|axis| cell[axis].min(self.size[axis] - 1))
    }
}

impl BevCells {
    /// Sorts points `[N]` of x, y, z (metres, sensor frame) and intensity into cells; those outside the detector's area,
    /// on the vehicle's own body or not finite are left out.
    pub fn new(points: &[[f32; 4]], format: &BevFormat) -> Self {
        let mut cloud = PointCloud::default();
        format.crop.keep(points, &mut cloud.xyzi);
        let Some(finest) = format.levels.first() else {
            return Self {
                cells: Vec::new(),
                places: Vec::new(),
                cloud,
            };
        };
        let [width, height] = finest.size;
        let mut columns = vec![CellPoints::NONE; width * height];
        for &[x, y, z, _] in &cloud.xyzi {
            let [low_x, low_y] = format.low_m;
            let [column, row] = finest.cell([x - low_x, y * format.y_sign - low_y]);
            // The row follows the network's y axis. The points of the cell stay in the sensor frame.
            columns[row * width + column].add([x, y, z]);
        }
        let occupied = columns
            .iter()
            .enumerate()
            .filter(|(_, column)| column.count > 0);
        let cells = occupied.map(|(number, column)| (number, column.cell()));
        let (numbers, cells): (Vec<usize>, Vec<SweepCell>) = cells.unzip();
        let places = format.levels.iter().map(|grid| {
            // Strides are whole numbers: the cells of a level are whole blocks of those of the finest.
            let steps =
                [0, 1].map(|axis| (grid.cell_m[axis] / finest.cell_m[axis]).round() as usize);
            let places = numbers.iter().map(|&number| {
                let column = number % width / steps[0];
                let row = number / width / steps[1];
                (row * grid.size[0] + column) as i64
            });
            places.collect()
        });
        Self {
            cells,
            places: places.collect(),
            cloud,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_kept_point_is_in_the_cell_of_its_place_on_every_level() {
        for y_axis in [YAxis::Left, YAxis::Right] {
            let config = DetectorConfig {
                y_axis,
                ..DetectorConfig::lean()
            };
            let format = BevFormat::of_detector(&config);
            let points = [
                [5.0, 3.0, -1.0, 0.5],
                [5.1, 3.1, 0.5, 0.5],
                [-20.0, -30.0, 0.0, 0.1],
                [99.0, 0.0, 0.0, 0.0],
            ];
            let sweep = BevCells::new(&points, &format);
            let both = sweep.cells.iter().find(|cell| cell.points == 2).unwrap();
            assert!((both.centroid_m[1] - 3.05).abs() < 1e-5 && (both.extent_m - 1.5).abs() < 1e-6);
            assert_eq!((sweep.cells.len(), sweep.cloud.xyzi.len()), (2, 3));
            for (grid, places) in format.levels.iter().zip(&sweep.places) {
                for (cell, &place) in sweep.cells.iter().zip(places) {
                    let [x, y, _] = cell.centroid_m;
                    let [column, row] =
                        grid.cell([x - format.low_m[0], y * format.y_sign - format.low_m[1]]);
                    assert_eq!(place, (row * grid.size[0] + column) as i64);
                }
            }
        }
    }

    #[test]
    fn sizes_are_those_of_the_detector() {
        let format = BevFormat::of_detector(&DetectorConfig::lean());
        assert_eq!(
            (
                format.local_channels(),
                format.cell_channels(),
                format.sweep_channels()
            ),
            (224, 480, 256)
        );
        assert_eq!(format.windows().collect::<Vec<_>>(), [[7, 7], [19, 19]]);
        assert!((format.range_m - 64.0).abs() < 0.1);
    }

    #[test]
    fn an_empty_sweep_has_no_cells() {
        let sweep = BevCells::new(
            &[[f32::NAN; 4]],
            &BevFormat::of_detector(&DetectorConfig::lean()),
        );
        assert!(sweep.cells.is_empty() && sweep.places.iter().all(Vec::is_empty));
    }
}
