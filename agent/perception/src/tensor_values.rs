//! Tensor values: plain numbers as a tensor, and the numbers of a tensor as a vector.

use tch::kind::Element;
use tch::{Device, Kind, TchError, Tensor, no_grad};

/// Tensor of plain numbers, row-major, on a device; one size of `shape` may be -1.
///
/// # Errors
/// Those of the tensor library, for example when the numbers do not fit the shape.
pub fn tensor<T: Element>(values: &[T], shape: &[i64], device: Device) -> Result<Tensor, TchError> {
    let tensor = Tensor::f_from_slice(values)?.f_view(shape)?;
    tensor.f_to_device(device)
}

/// Numbers of a tensor of any shape and device, row-major, as `f32`.
///
/// # Errors
/// Those of the tensor library.
pub fn values(tensor: &Tensor) -> Result<Vec<f32>, TchError> {
    let flat = no_grad(|| {
        let numbers = tensor.f_detach()?.f_to_kind(Kind::Float)?;
        numbers.f_reshape([-1])?.f_to_device(Device::Cpu)
    })?;
    Vec::try_from(&flat)
}
