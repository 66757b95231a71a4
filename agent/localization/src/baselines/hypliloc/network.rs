//! Network: two branches, two fusions with blocks of each modality between them, three poses.

use tch::nn::{self, Init};
use tch::{Kind, Tensor, no_grad};

use super::branch::Branch;
use super::fusion::BranchFusion;
use super::graph_attention::{GraphAttention, Space};
use super::panorama::{CircularLayer, panorama};
use super::token_layer::{TokenLayer, WIDTH};
use crate::baselines::place_classes::PlaceClasses;
use crate::baselines::regressed_pose::{PoseRegressor, RegressPose};
use crate::baselines::tokens::{RINGS, SECTORS, TOKENS};
use crate::pgc::dense::of_unit_length;

/// A HypLiLoc network of one scene, output of `agent train hypliloc`.
pub type HypLiLocLocalizer = PoseRegressor<HypLiLoc>;

/// The network of one scene.
#[derive(Debug)]
pub struct HypLiLoc {
    inward: TokenLayer,
    positions: Tensor,
    attention: GraphAttention,
    panorama: [CircularLayer; 2],
    first: BranchFusion,
    /// Block of the tokens of points.
    point_block: (TokenLayer, GraphAttention, TokenLayer),
    /// Block of the columns of the panorama.
    panorama_block: CircularLayer,
    second: BranchFusion,
    /// From points, panorama and fusion, the result.
    pub branches: [Branch; 3],
    /// `[3, 2]`: logarithms of the variances of position and heading of each branch, the weights of their losses.
    pub log_variances: Tensor,
}

impl HypLiLoc {
    /// Logarithms of the variances at the start: an error of the heading counts as ten of the position.
    pub const START: [f32; 2] = [0.0, -std::f32::consts::LN_10];

    /// Features of sweeps with tokens `[S, TOKENS, channels]` for each branch; layers of tokens compute in `kind`.
    ///
    /// # Errors
    /// Those of the tensor library.
    pub fn features(&self, tokens: &Tensor, kind: Kind, train: bool) -> tch::Result<[Tensor; 3]> {
        let tokens = tokens.f_to_kind(kind)?;
        let points = self.inward.forward(&tokens)?.f_to_kind(Kind::Float)?;
        let points = self.attention.forward(&points.f_add(&self.positions)?)?;
        let mut layers = self.panorama.iter();
        let columns = layers.try_fold(panorama(&tokens)?, |x, layer| layer.forward(&x))?;
        let columns = columns.f_to_kind(Kind::Float)?;

        let fused = self
            .first
            .forward(&of_unit_length(&points)?, &of_unit_length(&columns)?)?;
        let (inward, attention, outward) = &self.point_block;
        let of_points = inward.forward(&fused.f_narrow(1, 0, TOKENS)?)?;
        let of_points = outward.forward(&attention.forward(&of_points)?)?;
        let of_columns = fused.f_narrow(1, TOKENS, SECTORS)?;
        let of_columns = self.panorama_block.forward(&of_columns)?;
        let fused = self.second.forward(&of_points, &of_columns)?;

        let [of_points, of_columns, of_both] = &self.branches;
        Ok([
            of_points.features(&points.f_to_kind(kind)?, train)?,
            of_columns.features(&columns.f_to_kind(kind)?, train)?,
            of_both.features(&fused.f_to_kind(kind)?, train)?,
        ])
    }
}

impl RegressPose for HypLiLoc {
    const KIND: &'static str = "HypLiLoc";

    fn build(path: &nn::Path<'_>, channels: i64, classes: i64) -> tch::Result<Self> {
        let (block, branches) = (path / "point_block", path / "branches");
        let mut log_variances = path.var("log_variances", &[3, 2], Init::Const(0.0));
        no_grad(|| log_variances.f_copy_(&Tensor::from_slice(&Self::START)))?;
        let (mean, stdev) = (0.0, 0.1);
        Ok(Self {
            inward: TokenLayer::new(&(path / "inward"), channels),
            positions: path.var("positions", &[TOKENS, WIDTH], Init::Randn { mean, stdev }),
            attention: GraphAttention::plain(&(path / "attention")),
            panorama: [
                CircularLayer::new(&(path / "panorama0"), RINGS * channels),
                CircularLayer::new(&(path / "panorama1"), WIDTH),
            ],
            first: BranchFusion::new(&(path / "first_fusion")),
            point_block: (
                TokenLayer::new(&(&block / 0), WIDTH),
                GraphAttention::with_metric(&(&block / 1), Space::Euclidean),
                TokenLayer::new(&(&block / 2), WIDTH),
            ),
            panorama_block: CircularLayer::new(&(path / "panorama_block"), WIDTH),
            second: BranchFusion::new(&(path / "second_fusion")),
            branches: [
                Branch::new(&(&branches / "points"), TOKENS, classes),
                Branch::new(&(&branches / "panorama"), SECTORS, classes),
                Branch::new(&(&branches / "fusion"), TOKENS + SECTORS + 2, classes),
            ],
            log_variances,
        })
    }

    /// The class and the pose of the fusion.
    fn poses(&self, tokens: &Tensor, places: &PlaceClasses, kind: Kind) -> tch::Result<Tensor> {
        let [.., features] = self.features(tokens, kind, false)?;
        let [.., fusion] = &self.branches;
        let classes = fusion.classify(&features)?.f_argmax(1, false)?;
        places.absolute(&fusion.poses(&features, &classes)?, &classes)
    }
}
