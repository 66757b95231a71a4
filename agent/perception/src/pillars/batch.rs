//! Batch of pillars: one or more sweeps as the tensors that the pillar encoder takes.

use tch::{Device, Kind, Tensor};

use crate::model_config::DetectorConfig;
use crate::pillars::voxels::Pillars;

/// Inputs of the pillar encoder per point: x, y, z, intensity, offset from the pillar's mean, offset from its centre.
pub(crate) const POINT_FEATURES: usize = 10;

/// Grid of the pillars: converts cell indices into metres.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PillarGrid {
    /// Number of cells along x.
    pub width: usize,
    /// Number of cells along y.
    pub height: usize,
    /// Number of slots of a pillar.
    pub max_points: usize,
    size_m: [f32; 3],
    /// Centre of cell 0 along x, y, z, metres.
    first_center_m: [f32; 3],
}

impl PillarGrid {
    /// The pillar grid of a detector.
    pub fn new(config: &DetectorConfig) -> Self {
        let [width, height, _] = config.pillar_grid();
        Self {
            width,
            height,
            max_points: config.max_points_per_pillar,
            size_m: config.voxel_size_m.map(|size| size as f32),
            first_center_m: std::array::from_fn(|axis| {
                (config.voxel_size_m[axis] / 2.0 + config.lidar_range_m[axis]) as f32
            }),
        }
    }

    /// Centre x, y, z of the pillar at the cell indices z, y, x, metres.
    pub fn center_m(&self, zyx: [i32; 3]) -> [f32; 3] {
        std::array::from_fn(|axis| {
            zyx[2 - axis] as f32 * self.size_m[axis] + self.first_center_m[axis]
        })
    }

    /// Row-major index of a pillar's cell in `[H, W]`.
    pub fn cell(&self, [_, y, x]: [i32; 3]) -> usize {
        y as usize * self.width + x as usize
    }
}

/// Packed pillars of `B` sweeps: `P` points on `M` pillars.
#[derive(Debug)]
pub struct PillarBatch {
    /// `[P, 10]` `f32`: see `POINT_FEATURES`.
    pub features: Tensor,
    /// `[M]` `i64`: number of points of each pillar.
    pub counts: Tensor,
    /// `[M]` `i64`: index of each pillar's cell in `[B, H, W]`.
    pub cells: Tensor,
    /// `[M, 1]` `bool`: pillars with a free slot.
    pub partial: Tensor,
    /// Number of sweeps `B`.
    pub sweeps: i64,
}

impl PillarBatch {
    /// Computes the features of the points of `sweeps`, in this order.
    pub fn new(sweeps: &[&Pillars], pillar_grid: &PillarGrid) -> Self {
        let points: usize = sweeps.iter().map(|pillars| pillars.points.len()).sum();
        let total: usize = sweeps.iter().map(|pillars| pillars.len()).sum();
        let mut features = Vec::with_capacity(points * POINT_FEATURES);
        let mut cells = Vec::with_capacity(total);
        let mut counts = Vec::with_capacity(total);
        for (sweep, pillars) in sweeps.iter().enumerate() {
            let first_cell = sweep * pillar_grid.width * pillar_grid.height;
            for (points, coord) in pillars.iter() {
                let (mean, center) = (mean_xyz(points), pillar_grid.center_m(coord));
                for &[x, y, z, intensity] in points {
                    features.extend([x, y, z, intensity, x - mean[0], y - mean[1], z - mean[2]]);
                    features.extend([x - center[0], y - center[1], z - center[2]]);
                }
                cells.push((first_cell + pillar_grid.cell(coord)) as i64);
                counts.push(points.len() as i64);
            }
        }
        let counts = Tensor::from_slice(&counts);
        Self {
            features: Tensor::from_slice(&features).view([points as i64, POINT_FEATURES as i64]),
            partial: counts.lt(pillar_grid.max_points as i64).unsqueeze(1),
            counts,
            cells: Tensor::from_slice(&cells),
            sweeps: sweeps.len() as i64,
        }
    }

    /// The same tensors on another device.
    pub fn to_device(&self, device: Device) -> Self {
        Self {
            features: self.features.to_device(device),
            counts: self.counts.to_device(device),
            cells: self.cells.to_device(device),
            partial: self.partial.to_device(device),
            sweeps: self.sweeps,
        }
    }

    /// Number of points `P`.
    pub fn points(&self) -> i64 {
        self.features.size()[0]
    }

    /// Scatters one row per pillar onto the pillar grid.
    ///
    /// # Shapes
    /// - `rows`: `[M, C]`
    /// - returns: `[B, C, H, W]`, zero where there is no pillar; channels are innermost in memory, the layout that
    ///   convolutions on a CPU read fastest
    pub fn scatter(&self, rows: &Tensor, pillar_grid: &PillarGrid) -> Tensor {
        let (height, width) = (pillar_grid.height as i64, pillar_grid.width as i64);
        let channels = rows.size()[1];
        let size = [self.sweeps * height * width, channels];
        let canvas = Tensor::zeros(size, (Kind::Float, rows.device()));
        let canvas = canvas.index_copy(0, &self.cells, rows);
        canvas
            .view([self.sweeps, height, width, channels])
            .permute([0, 3, 1, 2])
    }
}

/// Mean position of the points of a pillar, metres.
pub(crate) fn mean_xyz(points: &[[f32; 4]]) -> [f32; 3] {
    let mut sum = [0.0_f32; 3];
    for point in points {
        for axis in 0..3 {
            sum[axis] += point[axis];
        }
    }
    sum.map(|sum| sum / points.len() as f32)
}
