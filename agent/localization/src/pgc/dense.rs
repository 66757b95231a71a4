//! Dense layer: a linear map of features.

use tch::nn::{self, Init};
use tch::{TchError, Tensor};

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
        Self {
            weight: path.var("weight", &[inputs, outputs], Init::Randn { mean: 0.0, stdev }),
            bias: path.var("bias", &[outputs], Init::Const(0.0)),
        }
    }

    /// `[N, inputs]` to `[N, outputs]`.
    pub(crate) fn forward(&self, x: &Tensor) -> Result<Tensor, TchError> {
        self.bias.to_kind(x.kind()).f_addmm(x, &self.weight.to_kind(x.kind()))
    }
}
