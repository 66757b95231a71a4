//! Scale of poses: what networks that regress poses learn, in place of metres in the world.

use nalgebra::{Isometry3, Vector3};
use perception::tensor_values::tensor;
use tch::{Device, TchError, Tensor};

use super::sweep_store::heading_rad;

/// Smallest deviation of positions along an axis, metres: scenes may be flat.
const LEAST_SCALE_M: f64 = 1.0;

/// Origin and unit of positions.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct PoseScale {
    /// Mean position, metres in the world.
    pub(super) origin_m: [f64; 3],
    /// Standard deviation of the positions, metres.
    pub(super) scale_m: [f64; 3],
}

impl PoseScale {
    /// Mean and deviation of poses.
    pub(super) fn of(poses: &[Isometry3<f64>]) -> Self {
        let count = poses.len() as f64;
        let mean =
            |value: &dyn Fn(&Isometry3<f64>) -> f64| poses.iter().map(value).sum::<f64>() / count;
        let origin_m: [f64; 3] =
            std::array::from_fn(|axis| mean(&|pose| pose.translation.vector[axis]));
        let variance =
            |axis: usize| mean(&|pose| (pose.translation.vector[axis] - origin_m[axis]).powi(2));
        let scale_m = std::array::from_fn(|axis| variance(axis).sqrt().max(LEAST_SCALE_M));
        Self { origin_m, scale_m }
    }

    /// `[S, 5]`: position in deviations from the origin, cosine and sine of the heading.
    pub(super) fn normalise(
        &self,
        poses: &[Isometry3<f64>],
        device: Device,
    ) -> Result<Tensor, TchError> {
        let row = |pose: &Isometry3<f64>| {
            let position = pose.translation.vector - Vector3::from(self.origin_m);
            let [x, y, z] = [0, 1, 2].map(|axis| (position[axis] / self.scale_m[axis]) as f32);
            let (sin, cos) = heading_rad(pose).sin_cos();
            [x, y, z, cos as f32, sin as f32]
        };
        let rows: Vec<f32> = poses.iter().flat_map(row).collect();
        tensor(&rows, &[-1, 5], device)
    }

    /// `[3]`: the unit, single precision.
    pub(super) fn unit_m(&self, device: Device) -> Result<Tensor, TchError> {
        tensor(&self.scale_m.map(|scale| scale as f32), &[3], device)
    }
}
