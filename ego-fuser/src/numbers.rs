//! Tensors as plain numbers, for loops that visit memory in an order that the tensor library does not.

use tch::{TchError, Tensor};

/// What a tensor of floats holds, row by row.
pub(crate) fn numbers(tensor: &Tensor) -> Result<Vec<f32>, TchError> {
    Vec::try_from(tensor.f_reshape(-1)?)
}
