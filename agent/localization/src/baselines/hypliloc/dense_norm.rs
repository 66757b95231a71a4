//! Rows through a dense layer, a norm and a ReLU.

use tch::nn::{self, BatchNormConfig, Init, LayerNormConfig, Module, ModuleT};
use tch::{TchError, Tensor};

use crate::pgc::dense::Dense;

/// Dense layer with batch norm and ReLU, of points.
#[derive(Debug)]
pub(super) struct BatchNormed {
    dense: Dense,
    norm: nn::BatchNorm,
}

impl BatchNormed {
    /// Builds a chain of layers of these channels below `path`.
    pub(super) fn chain(path: &nn::Path<'_>, channels: &[i64]) -> Vec<Self> {
        // Not by cuDNN, which is slow on a million rows of few channels.
        let config = BatchNormConfig {
            ws_init: Init::Const(1.0),
            cudnn_enabled: false,
            ..BatchNormConfig::default()
        };
        let layer = |(number, io): (usize, &[i64])| {
            let path = path / number;
            Self {
                dense: Dense::new(&path, io[0], io[1], 1.0),
                norm: nn::batch_norm1d(&path / "norm", io[1], config),
            }
        };
        channels.windows(2).enumerate().map(layer).collect()
    }

    /// `[N, C]` to `[N, C']`, in the precision of `x`.
    pub(super) fn forward(&self, x: &Tensor, train: bool) -> Result<Tensor, TchError> {
        self.norm.forward_t(&self.dense.forward(x)?, train).f_relu()
    }
}

/// Layer norm and ReLU after tokens.
#[derive(Debug)]
pub(super) struct TokenNorm(nn::LayerNorm);

impl TokenNorm {
    /// The identity, before it is trained, of normalised tokens.
    pub(super) fn new(path: &nn::Path<'_>, channels: i64) -> Self {
        Self(nn::layer_norm(
            path,
            vec![channels],
            LayerNormConfig::default(),
        ))
    }

    /// `[.., C]` in single precision.
    pub(super) fn forward(&self, x: &Tensor) -> Result<Tensor, TchError> {
        self.0.forward(x).f_relu()
    }
}

/// Dense layer, layer norm and ReLU, of tokens.
#[derive(Debug)]
pub(super) struct LayerNormed {
    dense: Dense,
    norm: TokenNorm,
}

impl LayerNormed {
    /// Builds a layer that keeps the number of channels.
    pub(super) fn new(path: &nn::Path<'_>, channels: i64) -> Self {
        Self {
            dense: Dense::new(path, channels, channels, 1.0),
            norm: TokenNorm::new(&(path / "norm"), channels),
        }
    }

    /// `[S, T, C]` in single precision.
    pub(super) fn forward(&self, tokens: &Tensor) -> Result<Tensor, TchError> {
        self.norm.forward(&of_tokens(&self.dense, tokens)?)
    }
}

/// A dense layer of tokens `[S, T, C]`.
pub(super) fn of_tokens(dense: &Dense, tokens: &Tensor) -> Result<Tensor, TchError> {
    let (sweeps, count, channels) = tokens.size3()?;
    dense
        .forward(&tokens.f_reshape([-1, channels])?)?
        .f_view([sweeps, count, -1])
}
