//! Network: two branches, two fusions with blocks of each modality between them, three heads.

use perception::layers::residual::ResidualBlock;
use tch::{Kind, TchError, Tensor, nn};

use super::dense_norm::TokenLayer;
use super::fusion::{Fusion, normalise};
use super::graph_attention::{GraphAttention, Space};
use super::image_branch::ImageBranch;
use super::point_branch::PointBranch;
use super::pose_head::{NormalisedPoses, PoseHead};
use super::sweep_input::InputBatch;

/// Channels of a token.
pub const WIDTH: i64 = 256;

/// Poses from the tokens of each branch.
#[derive(Debug)]
pub struct BranchPoses {
    /// Each `[S, WIDTH]`: features from which the poses of points, image and fusion come.
    pub features: [Tensor; 3],
    /// From points alone.
    pub points: NormalisedPoses,
    /// From the image alone.
    pub image: NormalisedPoses,
    /// From both, the result.
    pub fusion: NormalisedPoses,
}

/// The network of one scene.
#[derive(Debug)]
pub struct HypLiLoc {
    points: PointBranch,
    image: ImageBranch,
    first: Fusion,
    /// Block of the tokens of points.
    point_block: (TokenLayer, GraphAttention, TokenLayer),
    /// Block of the tokens of the image.
    image_block: Vec<ResidualBlock>,
    second: Fusion,
    heads: [PoseHead; 3],
}

impl HypLiLoc {
    /// Builds the layers below `path`.
    pub fn new(path: &nn::Path<'_>) -> Self {
        let block = path / "point_block";
        Self {
            points: PointBranch::new(&(path / "points")),
            image: ImageBranch::new(&(path / "image")),
            first: Fusion::new(&(path / "first_fusion")),
            point_block: (
                TokenLayer::new(&(&block / 0), WIDTH),
                GraphAttention::with_metric(&(&block / 1), WIDTH, Space::Euclidean),
                TokenLayer::new(&(&block / 2), WIDTH),
            ),
            image_block: ResidualBlock::chain(&(path / "image_block"), [WIDTH, WIDTH], 1, 1),
            second: Fusion::new(&(path / "second_fusion")),
            heads: ["points", "image", "fusion"]
                .map(|name| PoseHead::new(&(path / "heads" / name))),
        }
    }

    /// Poses of a batch; layers of points and image compute in `kind`, `train` as in batch normalisation.
    ///
    /// # Errors
    /// Those of the tensor library.
    pub fn forward(
        &self,
        batch: &InputBatch,
        kind: Kind,
        train: bool,
    ) -> Result<BranchPoses, TchError> {
        let points = self.points.forward(batch, kind, train)?;
        let map = self.image.forward(&batch.ranges_m, kind, train)?;
        let tokens_of = |map: &Tensor| map.f_flatten(2, 3)?.f_transpose(1, 2);
        let image = tokens_of(&map)?;
        let (count, cells) = (points.size()[1], image.size()[1]);

        let fused = self
            .first
            .forward(&normalise(&points)?, &normalise(&image)?)?;
        let (inward, attention, outward) = &self.point_block;
        let fused_points = inward.forward(&fused.f_narrow(1, 0, count)?)?;
        let fused_points = outward.forward(&attention.forward(&fused_points)?)?;
        let fused_map = fused.f_narrow(1, count, cells)?.f_transpose(1, 2)?;
        let fused_map = fused_map.f_reshape(map.size().as_slice())?;
        let fused_map = ResidualBlock::through(&self.image_block, fused_map, train);
        let fused = self
            .second
            .forward(&fused_points, &tokens_of(&fused_map)?)?;

        let [point_head, image_head, fusion_head] = &self.heads;
        let features = [
            point_head.features(&points, train)?,
            image_head.features(&image, train)?,
            fusion_head.features(&fused, train)?,
        ];
        Ok(BranchPoses {
            points: point_head.forward(&features[0])?,
            image: image_head.forward(&features[1])?,
            fusion: fusion_head.forward(&features[2])?,
            features,
        })
    }
}
