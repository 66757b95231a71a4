//! Network: two branches, two fusions with blocks of each modality between them, three heads.

use perception::layers::residual::ResidualBlock;
use tch::{Kind, TchError, Tensor, nn};

use super::dense_norm::LayerNormed;
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
    point_block: (LayerNormed, GraphAttention, LayerNormed),
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
                LayerNormed::new(&(&block / 0), WIDTH),
                GraphAttention::with_metric(&(&block / 1), WIDTH, Space::Euclidean),
                LayerNormed::new(&(&block / 2), WIDTH),
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
        let points = self
            .points
            .forward(&batch.points_m, &batch.groups, kind, train)?;
        let map = self.image.forward(&batch.ranges_m, kind, train)?;
        let (sweeps, channels, rows, columns) = map.size4()?;
        let tokens_of = |map: &Tensor| map.f_flatten(2, 3)?.f_transpose(1, 2);
        let image = tokens_of(&map)?;

        let fused = self
            .first
            .forward(&normalise(&points)?, &normalise(&image)?)?;
        let (count, cells) = (points.size()[1], rows * columns);
        let (inward, attention, outward) = &self.point_block;
        let fused_points = outward
            .forward(&attention.forward(&inward.forward(&fused.f_narrow(1, 0, count)?)?)?)?;
        let fused_map = fused.f_narrow(1, count, cells)?.f_transpose(1, 2)?;
        let fused_map = fused_map.f_reshape([sweeps, channels, rows, columns])?;
        let fused_map = self
            .image_block
            .iter()
            .fold(fused_map, |map, block| block.forward(&map, train));
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
