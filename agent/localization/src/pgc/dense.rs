//! Dense layer: a linear map of features.

use perception::int8::{Int8Linear, LayerFormat};
use tch::nn::{self, Init};
use tch::{Kind, Tensor};

/// `x W + b` in the precision of `x`.
#[derive(Debug)]
pub(crate) struct Dense {
    weight: Tensor,
    bias: Tensor,
}

impl Dense {
    /// He-initialised, times `gain`.
    pub(crate) fn new(path: &nn::Path<'_>, inputs: i64, outputs: i64, gain: f64) -> Self {
        let stdev = gain * (2.0 / inputs as f64).sqrt();
        let random = Init::Randn { mean: 0.0, stdev };
        Self {
            weight: path.var("weight", &[inputs, outputs], random),
            bias: path.var("bias", &[outputs], Init::Const(0.0)),
        }
    }

    /// `[.., inputs]` to `[.., outputs]`.
    pub(crate) fn forward(&self, x: &Tensor) -> tch::Result<Tensor> {
        let (inputs, outputs) = self.weight.size2()?;
        let mut shape = x.size();
        shape.pop();
        shape.push(outputs);
        let (weight, bias) = (self.weight.to_kind(x.kind()), self.bias.to_kind(x.kind()));
        bias.f_addmm(&x.f_reshape([-1, inputs])?, &weight)?
            .f_view(shape.as_slice())
    }

    /// The same in integers.
    pub(crate) fn int8(&self, format: LayerFormat) -> tch::Result<Int8Linear> {
        Int8Linear::new(&self.weight, Some(&self.bias), format)
    }
}

/// Features of length 1 along the last dimension.
///
/// # Errors
/// Those of the tensor library.
pub fn of_unit_length(x: &Tensor) -> tch::Result<Tensor> {
    let squares = x.f_square()?.f_sum_dim_intlist(-1_i64, true, Kind::Float)?;
    // The small number is added under the root, whose gradient is infinite at 0.
    x.f_div(&squares.f_add_scalar(1e-12)?.f_sqrt()?)
}
