//! Layer normalisation of tokens.

use tch::nn::{self, Init};
use tch::{TchError, Tensor};

/// Added to the variance.
const EPS: f64 = 1e-6;

/// Normalises the last dimension, in the precision of the input.
#[derive(Debug)]
pub(super) struct LayerNorm {
    weight: Tensor,
    bias: Tensor,
}

impl LayerNorm {
    /// Identity on normalised input.
    pub(super) fn new(path: &nn::Path<'_>, width: i64) -> Self {
        Self {
            weight: path.var("weight", &[width], Init::Const(1.0)),
            bias: path.var("bias", &[width], Init::Const(0.0)),
        }
    }

    /// `[.., width]` to the same.
    pub(super) fn forward(&self, x: &Tensor) -> Result<Tensor, TchError> {
        let (weight, bias) = (
            self.weight.f_to_kind(x.kind())?,
            self.bias.f_to_kind(x.kind())?,
        );
        x.f_layer_norm(self.weight.size(), Some(weight), Some(bias), EPS, true)
    }
}
