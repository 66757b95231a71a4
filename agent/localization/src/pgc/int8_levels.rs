//! Levels of the scene encoder in 8-bit integers.

use tch::Tensor;

use super::residual_group::Int8ResidualGroup;
use super::voxel_batch::VoxelBatch;
use perception::int8::Quantisation;
use perception::sparse::Int8SparseConv;

/// All levels but the first convolution, whose input is signed and has few channels.
#[derive(Debug)]
pub(super) struct Int8Levels {
    /// Output of the first convolution.
    pub(super) first: Quantisation,
    pub(super) down: Vec<Int8SparseConv>,
    /// On the level before the last.
    pub(super) fine: Option<Int8ResidualGroup>,
    /// On the last level, each with the quantisation of its input.
    pub(super) coarse: Vec<(Int8ResidualGroup, Quantisation)>,
    /// Output of the last convolution.
    pub(super) last: Quantisation,
}

impl Int8Levels {
    /// Features of the fine cells, if there are such, and of the coarse cells, `f32`, from the output of the first
    /// convolution.
    pub(super) fn forward(
        &self,
        first: &Tensor,
        batch: &VoxelBatch,
    ) -> tch::Result<(Option<Tensor>, Tensor)> {
        let mut x = self.first.quantise(first)?;
        let mut fine = None;
        for (level, conv) in self.down.iter().enumerate() {
            if level + 1 == self.down.len()
                && let (Some(group), Some(index)) = (&self.fine, &batch.fine)
            {
                fine = Some(group.forward(&x, index)?);
            }
            x = conv.forward(&x, &batch.down[level])?;
        }
        let mut coarse = None;
        for (group, input) in &self.coarse {
            // The first group takes the output of the convolutions, which is quantised already.
            if let Some(before) = &coarse {
                x = input.quantise(before)?;
            }
            coarse = Some(group.forward(&x, &batch.coarse)?);
        }
        Ok((fine, coarse.map_or_else(|| self.last.dequantise(&x), Ok)?))
    }
}
