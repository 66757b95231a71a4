//! Attention of every token to the points along its trajectory.

use tch::nn::{self, Init};
use tch::{TchError, Tensor};

use super::TrafAlignConfig;
use crate::warp::{BILINEAR, PADDING_ZEROS};

/// Multi-head attention to points between tokens, then an MLP, each with a residual and a norm after it.
#[derive(Debug)]
pub(super) struct TrajectoryAttention {
    /// Query, key and value in one.
    project: Linear,
    out: Linear,
    norm: LayerNorm,
    mlp: [Linear; 2],
    mlp_norm: LayerNorm,
    heads: i64,
}

impl TrajectoryAttention {
    pub(super) fn new(path: &nn::Path<'_>, config: &TrafAlignConfig) -> Self {
        let dim = config.dim;
        Self {
            project: Linear::new(&(path / "project"), [dim, 3 * dim]),
            out: Linear::new(&(path / "out"), [dim, dim]),
            norm: LayerNorm::new(&(path / "norm"), dim),
            mlp: [Linear::new(&(path / "mlp" / 0), [dim, 2 * dim]), Linear::new(&(path / "mlp" / 1), [2 * dim, dim])],
            mlp_norm: LayerNorm::new(&(path / "mlp_norm"), dim),
            heads: config.heads,
        }
    }

    /// Tokens `[A, D, h, w]` and points `[A, K h, w, 2]` to tokens.
    pub(super) fn forward(&self, tokens: &Tensor, points: &Tensor) -> Result<Tensor, TchError> {
        let (agents, dim, height, width) = tokens.size4()?;
        let last = tokens.f_permute([0, 2, 3, 1])?.f_contiguous()?;
        let projected = self.project.apply(&last)?.f_permute([0, 3, 1, 2])?.f_contiguous()?;
        let query = projected.f_narrow(1, 0, dim)?;
        let read = projected.f_narrow(1, dim, 2 * dim)?.f_grid_sampler(points, BILINEAR, PADDING_ZEROS, false)?;
        let per_head = dim / self.heads;
        let count = points.size()[1] / height;
        let split = |first: i64| {
            let part = read.f_narrow(1, first, dim)?;
            part.f_reshape([agents, self.heads, per_head, count, height, width])
        };
        let (keys, values) = (split(0)?, split(dim)?);
        let query = query.f_reshape([agents, self.heads, per_head, 1, height, width])?;
        let scores = (query * keys).f_sum_dim_intlist([2i64].as_slice(), true, None)? / (per_head as f64).sqrt();
        let weights = scores.f_softmax(3, None)?;
        let heard = (weights * values).f_sum_dim_intlist([3i64].as_slice(), false, None)?;
        let heard = heard.f_reshape([agents, dim, height, width])?.f_permute([0, 2, 3, 1])?.f_contiguous()?;
        let tokens = self.norm.apply(&(last + self.out.apply(&heard)?))?;
        let [first, second] = &self.mlp;
        let tokens = self.mlp_norm.apply(&(&tokens + second.apply(&first.apply(&tokens)?.f_relu()?)?))?;
        tokens.f_permute([0, 3, 1, 2])
    }
}

/// Over the last dimension.
#[derive(Debug)]
struct Linear {
    weight: Tensor,
    bias: Tensor,
}

impl Linear {
    fn new(path: &nn::Path<'_>, [input, output]: [i64; 2]) -> Self {
        let bound = 1.0 / (input as f64).sqrt();
        Self {
            weight: path.var("weight", &[output, input], nn::init::DEFAULT_KAIMING_UNIFORM),
            bias: path.var("bias", &[output], Init::Uniform { lo: -bound, up: bound }),
        }
    }

    fn apply(&self, x: &Tensor) -> Result<Tensor, TchError> {
        x.f_linear(&self.weight, Some(&self.bias))
    }
}

/// Over the last dimension.
#[derive(Debug)]
struct LayerNorm {
    weight: Tensor,
    bias: Tensor,
}

impl LayerNorm {
    fn new(path: &nn::Path<'_>, dim: i64) -> Self {
        Self { weight: path.var("weight", &[dim], Init::Const(1.0)), bias: path.var("bias", &[dim], Init::Const(0.0)) }
    }

    fn apply(&self, x: &Tensor) -> Result<Tensor, TchError> {
        x.f_layer_norm(self.weight.size(), Some(&self.weight), Some(&self.bias), 1e-5, true)
    }
}
