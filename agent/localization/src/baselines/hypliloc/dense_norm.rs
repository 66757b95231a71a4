//! Dense layers with norms and ReLUs, of points and of tokens.

use tch::nn::{self, BatchNormConfig, Init};
use tch::{TchError, Tensor};

use crate::baselines::layers::{DenseNorm, LayerNorm};
use crate::pgc::dense::Dense;

/// Added to variances of layer norms, PyTorch's own.
pub(super) const NORM_EPS: f64 = 1e-5;

/// Chain of dense layers with batch norm and ReLU, of points.
#[derive(Debug)]
pub(super) struct PointLayers(Vec<DenseNorm>);

impl PointLayers {
    /// Builds layers of these channels below `path`.
    pub(super) fn new(path: &nn::Path<'_>, channels: &[i64]) -> Self {
        // Not by cuDNN, which is slow on a million rows of few channels.
        let config = BatchNormConfig {
            ws_init: Init::Const(1.0),
            cudnn_enabled: false,
            ..BatchNormConfig::default()
        };
        let layers = channels.windows(2).enumerate();
        let layers =
            layers.map(|(number, io)| DenseNorm::new(&(path / number), [io[0], io[1]], config));
        Self(layers.collect())
    }

    /// `[N, C]` to `[N, C']`, in the precision of `x`.
    pub(super) fn forward(&self, x: Tensor, train: bool) -> Result<Tensor, TchError> {
        let mut layers = self.0.iter();
        layers.try_fold(x, |x, layer| layer.forward(&x, train)?.f_relu())
    }
}

/// Dense layer, layer norm and ReLU, of tokens.
#[derive(Debug)]
pub(super) struct TokenLayer {
    dense: Dense,
    norm: LayerNorm,
}

impl TokenLayer {
    /// Builds a layer that keeps the number of channels.
    pub(super) fn new(path: &nn::Path<'_>, channels: i64) -> Self {
        Self {
            dense: Dense::new(path, channels, channels, 1.0),
            norm: LayerNorm::new(&(path / "norm"), channels, NORM_EPS),
        }
    }

    /// `[S, T, C]` in single precision.
    pub(super) fn forward(&self, tokens: &Tensor) -> Result<Tensor, TchError> {
        self.around(tokens, Ok)
    }

    /// The same with a step between the dense layer and the norm.
    pub(super) fn around(
        &self,
        tokens: &Tensor,
        step: impl FnOnce(Tensor) -> Result<Tensor, TchError>,
    ) -> Result<Tensor, TchError> {
        self.norm
            .forward(&step(self.dense.forward(tokens)?)?)?
            .f_relu()
    }
}
