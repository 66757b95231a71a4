//! Set abstraction of PointNet++ (Qi et al. 2017) with graph attention between its centres.

use tch::nn;
use tch::{Kind, TchError, Tensor};

use super::dense_norm::BatchNormed;
use super::graph_attention::GraphAttention;
use super::groups::Neighbourhood;

/// Features of centres from those of their neighbours.
#[derive(Debug)]
pub(super) struct SetAbstraction {
    layers: Vec<BatchNormed>,
    attention: GraphAttention,
    neighbourhood: Neighbourhood,
}

impl SetAbstraction {
    /// Builds the layers of these `channels` below `path`, for neighbours with `inputs` features.
    pub(super) fn new(
        path: &nn::Path<'_>,
        neighbourhood: Neighbourhood,
        inputs: i64,
        channels: [i64; 3],
    ) -> Self {
        let [first, second, third] = channels;
        Self {
            layers: BatchNormed::chain(&(path / "layers"), &[3 + inputs, first, second, third]),
            attention: GraphAttention::plain(&(path / "attention"), third),
            neighbourhood,
        }
    }

    /// `[S, M, C']` features of the centres of `groups` `[S, M, K]`, from points `[S, N, 3]`, metres, and their features
    /// `[S, N, C]`. The layers compute in `kind`, the result is single.
    pub(super) fn forward(
        &self,
        points_m: &Tensor,
        features: Option<&Tensor>,
        groups: &Tensor,
        kind: Kind,
        train: bool,
    ) -> Result<Tensor, TchError> {
        let (sweeps, centres, neighbours) = groups.size3()?;
        let count = points_m.size()[1];
        let first = Tensor::f_arange(sweeps, (Kind::Int64, groups.device()))? * count;
        let rows = (groups.f_to_kind(Kind::Int64)? + first.f_view([-1, 1, 1])?).f_view([-1])?;
        let near = points_m
            .f_reshape([-1, 3])?
            .f_index_select(0, &rows)?
            .f_view([sweeps, centres, neighbours, 3])?;
        let offsets = (near - points_m.f_narrow(1, 0, centres)?.f_unsqueeze(2)?)
            / self.neighbourhood.radius_m;
        let mut x = offsets.f_view([-1, 3])?.f_to_kind(kind)?;
        if let Some(features) = features {
            let features = features
                .f_to_kind(kind)?
                .f_reshape([sweeps * count, -1])?
                .f_index_select(0, &rows)?;
            x = Tensor::f_cat(&[x, features], 1)?;
        }
        for layer in &self.layers {
            x = layer.forward(&x, train)?;
        }
        let (x, _) = x
            .f_view([sweeps, centres, neighbours, -1])?
            .f_max_dim(2, false)?;
        self.attention.forward(&x.f_to_kind(Kind::Float)?)
    }
}
