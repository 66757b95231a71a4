//! Fusion of the tokens of both branches in Euclidean and hyperbolic space.

use tch::nn::{self, Init};
use tch::{Kind, Tensor};

use super::graph_attention::{GraphAttention, Space};

/// Graph attention in both spaces, summed with learnt weights.
#[derive(Debug)]
pub(super) struct BranchFusion {
    euclidean: GraphAttention,
    poincare: GraphAttention,
    weights: Tensor,
}

impl BranchFusion {
    /// Builds the layers below `path`.
    pub(super) fn new(path: &nn::Path<'_>) -> Self {
        Self {
            euclidean: GraphAttention::with_metric(&(path / "euclidean"), Space::Euclidean),
            poincare: GraphAttention::with_metric(&(path / "poincare"), Space::Poincare),
            weights: path.var("weights", &[2], Init::Const(1.0)),
        }
    }

    /// `[S, P + C + 2, WIDTH]` of tokens `[S, P, WIDTH]` of points and `[S, C, WIDTH]` of columns: in this order, then
    /// one pooled token of each.
    pub(super) fn forward(&self, points: &Tensor, columns: &Tensor) -> tch::Result<Tensor> {
        let [of_points, of_columns] =
            [points, columns].map(|tokens| tokens.f_mean_dim(1_i64, true, Kind::Float));
        let tokens = Tensor::f_cat(&[points, columns, &of_points?, &of_columns?], 1)?;
        let [flat, curved] = [0, 1].map(|number| self.weights.f_select(0, number));
        let euclidean = self.euclidean.forward(&tokens)?.f_mul(&flat?)?;
        euclidean.f_add(&self.poincare.forward(&tokens)?.f_mul(&curved?)?)
    }
}
