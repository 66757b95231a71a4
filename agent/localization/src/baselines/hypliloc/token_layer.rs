//! Layer of tokens: dense, layer norm and ReLU.

use tch::{Tensor, nn};

use crate::baselines::layers::TokenNorm;
use crate::pgc::dense::Dense;

/// Channels of a token.
pub(super) const WIDTH: i64 = 128;
/// Added to variances of layer norms, PyTorch's own.
const NORM_EPS: f64 = 1e-5;

/// Dense layer, layer norm and ReLU.
#[derive(Debug)]
pub(super) struct TokenLayer {
    dense: Dense,
    norm: TokenNorm,
}

impl TokenLayer {
    /// Builds the layer below `path`.
    pub(super) fn new(path: &nn::Path<'_>, inputs: i64) -> Self {
        Self {
            dense: Dense::new(path, inputs, WIDTH, 1.0),
            norm: TokenNorm::new(&(path / "norm"), WIDTH, NORM_EPS),
        }
    }

    /// `[S, T, C]` to `[S, T, C']`, in the precision of the tokens.
    pub(super) fn forward(&self, tokens: &Tensor) -> tch::Result<Tensor> {
        self.around(tokens, Ok)
    }

    /// The same with a step between the dense layer and the norm.
    pub(super) fn around(
        &self,
        tokens: &Tensor,
        step: impl FnOnce(Tensor) -> tch::Result<Tensor>,
    ) -> tch::Result<Tensor> {
        (self.norm.forward(&step(self.dense.forward(tokens)?)?)?).f_relu()
    }
}
