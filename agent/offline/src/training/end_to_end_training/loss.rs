//! Losses of the competitors: absolute differences, as in SGLoc and the pose regressors.

use nalgebra::{Isometry3, Vector3};
use tch::{Device, Kind, TchError, Tensor};

use localization::competitors::EndToEnd;

/// Weight of a unit of heading (about 57 degrees), metres.
const HEADING_WEIGHT_M: f64 = 30.0;

/// Loss of regressed coordinates: features `[N, cell_channels]` of cells at `[N, 3]` in the sensor frame against
/// `[N, 3]` relative to the network's origin, metres. Also the mean L1 error in metres.
pub(super) fn coordinate_loss(
    network: &EndToEnd,
    cells: &Tensor,
    sensor_m: &Tensor,
    targets_m: &Tensor,
) -> Result<(Tensor, f64), TchError> {
    let error = mean_l1(&network.coordinates(cells, sensor_m, true)?, targets_m)?;
    let metres = error.f_double_value(&[])?;
    Ok((error, metres))
}

/// Loss of regressed poses: features `[S, sweep_channels]` against true poses. Also the mean L1 error of the position
/// in metres.
pub(super) fn pose_loss(network: &EndToEnd, sweeps: &Tensor, truth: &Truth) -> Result<(Tensor, f64), TchError> {
    let (position, heading) = network.poses(sweeps)?;
    let error = mean_l1(&position, &truth.positions_m)?;
    let turn = mean_l1(&heading, &truth.headings)?;
    let metres = error.f_double_value(&[])?;
    Ok((error + turn * HEADING_WEIGHT_M, metres))
}

/// True poses as tensors of the loss.
pub(super) struct Truth {
    /// `[S, 3]` relative to an origin, metres.
    positions_m: Tensor,
    /// `[S, 2]`: cosine and sine.
    headings: Tensor,
}

impl Truth {
    /// Poses of sensors in the world.
    pub(super) fn new<'a>(
        world_from_sensor: impl Iterator<Item = &'a Isometry3<f64>>,
        origin_m: [f64; 3],
        device: Device,
    ) -> Result<Self, TchError> {
        let (mut positions, mut headings) = (Vec::new(), Vec::new());
        for pose in world_from_sensor {
            let position = pose.translation.vector - Vector3::from(origin_m);
            let ahead = (pose.rotation * Vector3::x()).xy().normalize();
            positions.extend(position.iter().map(|&axis| axis as f32));
            headings.extend(ahead.iter().map(|&axis| axis as f32));
        }
        let tensor =
            |values: &[f32], columns: i64| Tensor::f_from_slice(values)?.f_view([-1, columns])?.f_to_device(device);
        Ok(Self { positions_m: tensor(&positions, 3)?, headings: tensor(&headings, 2)? })
    }

    /// Some rows of it.
    pub(super) fn select(&self, rows: &Tensor) -> Result<Self, TchError> {
        Ok(Self {
            positions_m: self.positions_m.f_index_select(0, rows)?,
            headings: self.headings.f_index_select(0, rows)?,
        })
    }
}

fn mean_l1(found: &Tensor, wanted: &Tensor) -> Result<Tensor, TchError> {
    (found - wanted).f_abs()?.f_sum_dim_intlist(1_i64, false, Kind::Float)?.f_mean(Kind::Float)
}
