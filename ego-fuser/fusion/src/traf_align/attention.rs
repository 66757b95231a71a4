//! Deformable attention of every token to the points along its trajectory.

use tch::{TchError, Tensor, nn};

use super::config::TrafAlignConfig;
use crate::layers::{LayerNorm, Linear, uniform};
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
            project: linear(&(path / "project"), [dim, 3 * dim]),
            out: linear(&(path / "out"), [dim, dim]),
            norm: LayerNorm::new(&(path / "norm"), dim),
            mlp: [
                linear(&(path / "mlp" / 0), [dim, 2 * dim]),
                linear(&(path / "mlp" / 1), [2 * dim, dim]),
            ],
            mlp_norm: LayerNorm::new(&(path / "mlp_norm"), dim),
            heads: config.heads,
        }
    }

    /// Tokens `[A, D, h, w]` and points `[A, K h, w, 2]` to tokens.
    pub(super) fn forward(&self, tokens: &Tensor, points: &Tensor) -> Result<Tensor, TchError> {
        let (agents, dim, height, width) = tokens.size4()?;
        let last = tokens.f_permute([0, 2, 3, 1])?.f_contiguous()?;
        let projected = self.project.forward(&last)?.f_permute([0, 3, 1, 2])?;
        let projected = projected.f_contiguous()?;
        let query = projected.f_narrow(1, 0, dim)?;
        let read = projected.f_narrow(1, dim, 2 * dim)?;
        let read = read.f_grid_sampler(points, BILINEAR, PADDING_ZEROS, false)?;
        let per_head = dim / self.heads;
        // The points of all tokens are stacked along the rows: [K h, w].
        let count = points.size()[1] / height;
        let [keys, values] = [0, dim].map(|first| {
            let part = read.f_narrow(1, first, dim)?;
            part.f_reshape([agents, self.heads, per_head, count, height, width])
        });
        let (keys, values) = (keys?, values?);
        let query = query.f_reshape([agents, self.heads, per_head, 1, height, width])?;
        let scores = (query * keys).f_sum_dim_intlist([2i64].as_slice(), true, None)?
            / (per_head as f64).sqrt();
        let weights = scores.f_softmax(3, None)?;
        let attended = (weights * values).f_sum_dim_intlist([3i64].as_slice(), false, None)?;
        let attended = attended.f_reshape([agents, dim, height, width])?;
        let attended = attended.f_permute([0, 2, 3, 1])?.f_contiguous()?;
        let tokens = self.norm.forward(&(last + self.out.forward(&attended)?))?;
        let [first, second] = &self.mlp;
        let inner = second.forward(&first.forward(&tokens)?.f_relu()?)?;
        let tokens = self.mlp_norm.forward(&(&tokens + inner))?;
        tokens.f_permute([0, 3, 1, 2])
    }
}

/// A linear layer whose bias is random at the start, like its weight.
fn linear(path: &nn::Path<'_>, [input, output]: [i64; 2]) -> Linear {
    let bound = 1.0 / (input as f64).sqrt();
    let init = nn::init::DEFAULT_KAIMING_UNIFORM;
    Linear {
        weight: path.var("weight", &[output, input], init),
        bias: Some(path.var("bias", &[output], uniform(bound))),
    }
}
