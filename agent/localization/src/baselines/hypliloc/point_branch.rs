//! Point branch: two set abstractions of PointNet++ (Qi et al. 2017) with graph attention between their centres, then
//! layers of each centre, to 64 tokens.

use tch::nn;
use tch::{Kind, TchError, Tensor};

use super::dense_norm::PointLayers;
use super::graph_attention::GraphAttention;
use super::groups::{COARSE, FINE};
use super::network::WIDTH;
use super::sweep_input::InputBatch;

/// Unit of the positions of centres, metres.
const SCALE_M: f64 = 40.0;

/// Points to tokens.
#[derive(Debug)]
pub(super) struct PointBranch {
    fine: SetAbstraction,
    coarse: SetAbstraction,
    layers: PointLayers,
}

impl PointBranch {
    /// Builds the layers below `path`.
    pub(super) fn new(path: &nn::Path<'_>) -> Self {
        let (fine_m, coarse_m) = (FINE.radius_m, COARSE.radius_m);
        let widths = [3 + 128, 128, 256, 512, 256, 128, WIDTH];
        Self {
            fine: SetAbstraction::new(&(path / "fine"), fine_m, [3, 32, 32, 64]),
            coarse: SetAbstraction::new(&(path / "coarse"), coarse_m, [3 + 64, 64, 64, 128]),
            layers: PointLayers::new(&(path / "tokens"), &widths),
        }
    }

    /// `[S, 64, WIDTH]` tokens of the points of a batch. Layers of neighbours compute in `kind`, the result is single.
    pub(super) fn forward(
        &self,
        batch: &InputBatch,
        kind: Kind,
        train: bool,
    ) -> Result<Tensor, TchError> {
        let InputBatch {
            points_m,
            fine,
            coarse,
            ..
        } = batch;
        let features = self.fine.forward(points_m, None, fine, kind, train)?;
        let centres_m = points_m.f_narrow(1, 0, FINE.centres)?;
        let features = self
            .coarse
            .forward(&centres_m, Some(&features), coarse, kind, train)?;
        let centres = points_m.f_narrow(1, 0, COARSE.centres)? / SCALE_M;
        let x = Tensor::f_cat(&[centres, features], 2)?.f_view([-1, 3 + 128])?;
        self.layers
            .forward(x, train)?
            .f_view([-1, COARSE.centres, WIDTH])
    }
}

/// Features of centres from those of their neighbours.
#[derive(Debug)]
struct SetAbstraction {
    layers: PointLayers,
    attention: GraphAttention,
    radius_m: f64,
}

impl SetAbstraction {
    /// Builds the layers of these channels below `path`: of a neighbour's position and features first.
    fn new(path: &nn::Path<'_>, radius_m: f64, channels: [i64; 4]) -> Self {
        Self {
            layers: PointLayers::new(&(path / "layers"), &channels),
            attention: GraphAttention::plain(&(path / "attention"), channels[3]),
            radius_m,
        }
    }

    /// `[S, M, C']` features of the centres of `groups` `[S, M, K]`, from points `[S, N, 3]`, metres, and their features
    /// `[S, N, C]`. The layers compute in `kind`, the result is single.
    fn forward(
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
        let near = points_m.f_reshape([-1, 3])?.f_index_select(0, &rows)?;
        let near = near.f_view([sweeps, centres, neighbours, 3])?;
        let offsets = near - points_m.f_narrow(1, 0, centres)?.f_unsqueeze(2)?;
        let mut x = (offsets / self.radius_m).f_view([-1, 3])?.f_to_kind(kind)?;
        if let Some(features) = features {
            let features = features.f_to_kind(kind)?.f_reshape([sweeps * count, -1])?;
            x = Tensor::f_cat(&[x, features.f_index_select(0, &rows)?], 1)?;
        }
        let x = self.layers.forward(x, train)?;
        let (x, _) = x
            .f_view([sweeps, centres, neighbours, -1])?
            .f_max_dim(2, false)?;
        self.attention.forward(&x.f_to_kind(Kind::Float)?)
    }
}
