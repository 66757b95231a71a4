//! Tensor values: the numbers of a tensor as a vector.

use tch::{Device, Kind, TchError, Tensor, no_grad};

/// Numbers of a tensor of any shape and device, row-major, as `f32`.
///
/// # Errors
/// Those of the tensor library.
pub fn values(tensor: &Tensor) -> Result<Vec<f32>, TchError> {
    let flat = no_grad(|| {
        tensor
            .f_detach()?
            .f_to_kind(Kind::Float)?
            .f_reshape([-1])?
            .f_to_device(Device::Cpu)
    })?;
    Vec::try_from(&flat)
}
