//! Layer of tokens: dense, layer norm and ReLU.

use tch::nn;
use tch::{TchError, Tensor};

use crate::baselines::layers::LayerNorm;
use crate::pgc::dense::Dense;

/// Added to variances of layer norms, PyTorch's own.
const NORM_EPS: f64 = 1e-5;

/// Dense layer, layer norm and ReLU.
#[derive(Debug)]
pub(super) struct TokenLayer {
    dense: Dense,
    norm: LayerNorm,
}

impl TokenLayer {
    /// Builds the layer below `path`.
    pub(super) fn new(path: &nn::Path<'_>, [inputs, outputs]: [i64; 2]) -> Self {
        Self {
            dense: Dense::new(path, inputs, outputs, 1.0),
            norm: LayerNorm::new(&(path / "norm"), outputs, NORM_EPS),
        }
    }

    /// `[S, T, C]` to `[S, T, C']`, in the precision of the tokens.
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
