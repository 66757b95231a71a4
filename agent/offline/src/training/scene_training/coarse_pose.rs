//! Coarse poses for the training of the refiner, drawn around true ones.

use nalgebra::Isometry3;
use tch::{Device, Kind, Result, Tensor};

use crate::training::sweep_store::heading_rad;

/// Standard deviation of the largest position errors that the refiner starts from, metres.
const MAX_ERROR_M: f64 = 2.5;
/// Standard deviation of the heading errors that it starts from, radians.
const TURN_RAD: f64 = 0.015;

/// `[S]`: true heading of each sweep's sensor, radians.
pub(super) fn headings(world_from_sensor: &[Isometry3<f64>], device: Device) -> Result<Tensor> {
    let poses = world_from_sensor.iter();
    let headings: Vec<f32> = poses.map(|pose| heading_rad(pose) as f32).collect();
    Tensor::f_from_slice(&headings)?.f_to_device(device)
}

/// Positions of cells `[N, 3]` with random errors, and cosine and sine of the heading `[N, 2]` with random errors;
/// `sweeps` `[N]` is the sweep of each cell.
pub(super) fn draw(
    headings: &Tensor,
    targets_m: &Tensor,
    sweeps: &Tensor,
) -> Result<(Tensor, Tensor)> {
    let like = (Kind::Float, targets_m.device());
    let count = targets_m.size()[0];
    // Small and large errors both occur: the second round starts from a better pose than the first.
    let scale = Tensor::f_rand([count, 1], like)?.f_square()? * MAX_ERROR_M;
    let axes = Tensor::f_from_slice(&[1.0f32, 1.0, 0.3])?.f_to_device(like.1)?;
    let shift = Tensor::f_randn([count, 3], like)? * scale * axes;
    let turn = Tensor::f_randn([count], like)? * TURN_RAD;
    let yaw = headings.f_index_select(0, sweeps)? + turn;
    let heading = Tensor::f_stack(&[yaw.f_cos()?, yaw.f_sin()?], 1)?;
    Ok((targets_m + shift, heading))
}
