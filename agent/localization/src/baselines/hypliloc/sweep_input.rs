//! Input of both branches: sampled points and the spherical image of a sweep.

use tch::{Device, Kind, TchError, Tensor};

use super::groups::Groups;
use super::range_image::{COLUMNS, ROWS, range_image};
use super::sampling::{farthest_points, thin};

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
    /// Neighbours among the points.
    pub groups: Groups,
}

impl InputBatch {
    /// Copies inputs onto a device; ranges in half precision.
    ///
    /// # Errors
    /// Those of the tensor library.
    pub fn new(sweeps: &[SweepInput], device: Device) -> Result<Self, TchError> {
        let points: Vec<f32> = sweeps
            .iter()
            .flat_map(|sweep| sweep.points_m.as_flattened())
            .copied()
            .collect();
        let ranges: Vec<f32> = sweeps
            .iter()
            .flat_map(|sweep| &sweep.ranges_m)
            .copied()
            .collect();
        let points_m = Tensor::f_from_slice(&points)?
            .f_view([-1, POINTS, 3])?
            .f_to_device(device)?;
        let ranges_m = Tensor::f_from_slice(&ranges)?
            .f_view([-1, ROWS, COLUMNS])?
            .f_to_kind(Kind::Half)?;
        let groups = Groups::find(&points_m)?;
        Ok(Self {
            points_m,
            ranges_m: ranges_m.f_to_device(device)?,
            groups,
        })
    }

    /// Several batches as one.
    ///
    /// # Errors
    /// Those of the tensor library.
    pub fn concatenate(batches: Vec<Self>) -> Result<Self, TchError> {
        let (mut points, mut ranges, mut groups) = (Vec::new(), Vec::new(), Vec::new());
        for batch in batches {
            points.push(batch.points_m);
            ranges.push(batch.ranges_m);
            groups.push(batch.groups);
        }
        let (points_m, ranges_m) = (Tensor::f_cat(&points, 0)?, Tensor::f_cat(&ranges, 0)?);
        Ok(Self {
            points_m,
            ranges_m,
            groups: Groups::concatenate(&groups)?,
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
            groups: self.groups.select(rows)?,
        })
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
