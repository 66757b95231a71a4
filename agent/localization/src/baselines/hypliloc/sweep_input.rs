//! Input of both branches: sampled points and the spherical image of a sweep.

use tch::{Device, Kind, TchError, Tensor};

use super::groups::{COARSE, FINE, neighbours, without};
use super::range_image::{COLUMNS, ROWS, range_image};
use super::sampling::{farthest_points, thin};
use perception::tensor_values::tensor;

/// Points of a sweep.
pub const POINTS: i64 = 1024;
/// Points farther than this from the sensor are left out, metres.
pub const RANGE_M: f64 = 80.0;
/// Smallest number of voxels of a sweep that can be localized.
const MIN_VOXELS: usize = 64;

/// Input of the network from one sweep.
#[derive(Debug, Clone, PartialEq)]
pub struct SweepInput {
    /// [`POINTS`] points in the order of farthest-point sampling, metres in the sensor frame.
    points_m: Vec<[f32; 3]>,
    /// Spherical image, row by row, metres; 0 where no point is.
    ranges_m: Vec<f32>,
}

impl SweepInput {
    /// Samples a sweep, metres in the sensor frame; `None` if it shows too little.
    pub fn new(points_m: &[[f32; 3]]) -> Option<Self> {
        let range_m = RANGE_M as f32;
        let thinned = thin(points_m, range_m);
        (thinned.len() >= MIN_VOXELS).then(|| Self {
            points_m: farthest_points(&thinned, POINTS as usize),
            ranges_m: range_image(points_m, range_m),
        })
    }
}

/// Inputs of some sweeps on a device.
#[derive(Debug)]
pub struct InputBatch {
    /// `[S, POINTS, 3]` in single precision, metres in the sensor frame.
    pub points_m: Tensor,
    /// `[S, ROWS, COLUMNS]`, metres.
    pub ranges_m: Tensor,
    /// `[S, 256, 24]`: rows of the points near each centre of the first set abstraction.
    pub fine: Tensor,
    /// `[S, 64, 32]`: rows of these centres near each centre of the second one.
    pub coarse: Tensor,
}

impl InputBatch {
    /// Copies inputs onto a device; ranges in half precision.
    ///
    /// # Errors
    /// Those of the tensor library.
    pub fn new(sweeps: &[SweepInput], device: Device) -> Result<Self, TchError> {
        let points = sweeps
            .iter()
            .flat_map(|sweep| sweep.points_m.as_flattened());
        let points: Vec<f32> = points.copied().collect();
        let ranges = sweeps.iter().flat_map(|sweep| &sweep.ranges_m);
        let ranges: Vec<f32> = ranges.copied().collect();
        let points_m = tensor(&points, &[-1, POINTS, 3], device)?;
        let ranges_m = tensor(&ranges, &[-1, ROWS, COLUMNS], Device::Cpu)?;
        Ok(Self {
            fine: neighbours(&points_m, FINE)?,
            coarse: neighbours(&points_m.f_narrow(1, 0, FINE.centres)?, COARSE)?,
            points_m,
            ranges_m: ranges_m.f_to_kind(Kind::Half)?.f_to_device(device)?,
        })
    }

    /// Several batches as one.
    ///
    /// # Errors
    /// Those of the tensor library.
    pub fn concatenate(batches: &[Self]) -> Result<Self, TchError> {
        let all = |part: fn(&Self) -> &Tensor| {
            Tensor::f_cat(&batches.iter().map(part).collect::<Vec<_>>(), 0)
        };
        Ok(Self {
            points_m: all(|batch| &batch.points_m)?,
            ranges_m: all(|batch| &batch.ranges_m)?,
            fine: all(|batch| &batch.fine)?,
            coarse: all(|batch| &batch.coarse)?,
        })
    }

    /// The sweeps `rows` `[B]`.
    ///
    /// # Errors
    /// Those of the tensor library.
    pub fn select(&self, rows: &Tensor) -> Result<Self, TchError> {
        Ok(Self {
            points_m: self.points_m.f_index_select(0, rows)?,
            ranges_m: self.ranges_m.f_index_select(0, rows)?,
            fine: self.fine.f_index_select(0, rows)?,
            coarse: self.coarse.f_index_select(0, rows)?,
        })
    }

    /// Neighbours of the first set abstraction, replaced by their centre where points are dropped, `[S, POINTS]`.
    ///
    /// # Errors
    /// Those of the tensor library.
    pub fn fine_without(&self, is_dropped: &Tensor) -> Result<Tensor, TchError> {
        without(&self.fine, is_dropped)
    }

    /// Number of sweeps.
    pub fn len(&self) -> i64 {
        self.points_m.size()[0]
    }

    /// True if there is no sweep.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }
}
