//! Layers that several baselines share.

use tch::Tensor;
use tch::nn::{self, BatchNormConfig, Init, ModuleT};

use crate::pgc::dense::Dense;

/// Normalises the last dimension, in the precision of the input.
#[derive(Debug)]
pub(super) struct TokenNorm {
    weight: Tensor,
    bias: Tensor,
    eps: f64,
}

impl TokenNorm {
    /// Identity on normalised input; `eps` is added to the variance.
    pub(super) fn new(path: &nn::Path<'_>, width: i64, eps: f64) -> Self {
        Self {
            weight: path.var("weight", &[width], Init::Const(1.0)),
            bias: path.var("bias", &[width], Init::Const(0.0)),
            eps,
        }
    }

    /// `[.., width]` to the same.
    pub(super) fn forward(&self, x: &Tensor) -> tch::Result<Tensor> {
        let weight = self.weight.f_to_kind(x.kind())?;
        let bias = self.bias.f_to_kind(x.kind())?;
        x.f_layer_norm(self.weight.size(), Some(weight), Some(bias), self.eps, true)
    }
}

/// Dense layer with batch norm.
#[derive(Debug)]
pub(super) struct DenseNorm {
    dense: Dense,
    norm: nn::BatchNorm,
}

impl DenseNorm {
    /// Builds the layers below `path`.
    pub(super) fn new(path: &nn::Path<'_>, io: [i64; 2]) -> Self {
        Self {
            dense: Dense::new(path, io[0], io[1], 1.0),
            norm: nn::batch_norm1d(path / "norm", io[1], BatchNormConfig::default()),
        }
    }

    /// `[N, C]` to `[N, C']`, in the precision of `x`.
    pub(super) fn forward(&self, x: &Tensor, train: bool) -> tch::Result<Tensor> {
        Ok(self.norm.forward_t(&self.dense.forward(x)?, train))
    }
}
