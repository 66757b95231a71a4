//! Graph attention between all tokens of a sweep, in Euclidean space or in Poincare balls.

use tch::nn::{self, Init};
use tch::{Tensor, no_grad};

use super::poincare::{expmap0, logmap0};
use super::token_layer::{TokenLayer, WIDTH};

/// Heads of the attention.
const HEADS: i64 = 8;

/// Space in which tokens are compared and averaged.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Space {
    /// Vectors.
    Euclidean,
    /// Points of one ball for each head.
    Poincare,
}

/// One layer: linear map, attention, layer norm, ReLU.
#[derive(Debug)]
pub(super) struct GraphAttention {
    metric: Option<Tensor>,
    layer: TokenLayer,
    space: Space,
}

impl GraphAttention {
    /// Attention by the scalar product, between points.
    pub(super) fn plain(path: &nn::Path<'_>) -> Self {
        Self {
            metric: None,
            layer: TokenLayer::new(path, WIDTH),
            space: Space::Euclidean,
        }
    }

    /// Attention by a learnt metric, which all heads share; it begins as the identity.
    pub(super) fn with_metric(path: &nn::Path<'_>, space: Space) -> Self {
        let edge = WIDTH / HEADS;
        let mut metric = path.var("metric", &[edge, edge], Init::Const(0.0));
        no_grad(|| metric.copy_(&Tensor::eye(edge, (metric.kind(), metric.device()))));
        Self {
            metric: Some(metric),
            space,
            ..Self::plain(path)
        }
    }

    /// `[S, T, C]` in single precision.
    ///
    /// Weighted means of points of a ball lie in it, since it is convex.
    pub(super) fn forward(&self, tokens: &Tensor) -> tch::Result<Tensor> {
        let (sweeps, count, channels) = tokens.size3()?;
        self.layer.around(tokens, |values| {
            let values = values.f_view([sweeps, count, HEADS, channels / HEADS])?;
            let values = values.f_transpose(1, 2)?;
            let mean = match self.space {
                Space::Euclidean => self.attend(&values)?,
                Space::Poincare => logmap0(&self.attend(&expmap0(&values)?)?)?,
            };
            mean.f_transpose(1, 2)?.f_reshape([sweeps, count, channels])
        })
    }

    /// Means of values `[S, HEADS, T, C / HEADS]`, weighted by their similarities.
    fn attend(&self, values: &Tensor) -> tch::Result<Tensor> {
        let query = match &self.metric {
            Some(metric) => values.f_matmul(metric)?,
            None => values.shallow_clone(),
        };
        let mask = None::<Tensor>;
        Tensor::f_scaled_dot_product_attention(&query, values, values, mask, 0.0, false, 1.0, false)
    }
}
