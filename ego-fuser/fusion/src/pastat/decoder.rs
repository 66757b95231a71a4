//! Decoder: the context of the transformer and the aligned maps become one map, which the detection head of Eq. 3
//! reads.

use tch::nn::{self, Module};
use tch::{Kind, TchError, Tensor};

use super::config::PastatConfig;
use super::patches::{Tokens, channels_last};
use super::spatial_alignment::FineMaps;
use crate::f64_tensor::{self, are_numbers};
use crate::layers::ZERO;

/// Tokens back to cells. The context of the transformer is used in two ways: as a weight of each neighbour's newest
/// map, of which the maximum is taken, and as an additive change of that; neutral before training.
#[derive(Debug)]
pub(super) struct Decoder {
    gate_hidden: nn::Linear,
    gate_out: nn::Linear,
    norm: nn::LayerNorm,
    cells: nn::Linear,
    channels: i64,
    patch: i64,
}

impl Decoder {
    /// Its variables are `gate.*` and `decoder.*` below `path`.
    pub(super) fn new(path: &nn::Path<'_>, config: &PastatConfig) -> Self {
        let (channels, dim, patch) = (config.channels, config.dim, config.patch);
        let (gate, path) = (path / "gate", path / "decoder");
        Self {
            gate_hidden: nn::linear(&gate / "hidden", 2 * dim, dim, nn::LinearConfig::default()),
            gate_out: nn::linear(&gate / "out", dim, 1, ZERO),
            norm: nn::layer_norm(&path / "norm", vec![dim], nn::LayerNormConfig::default()),
            cells: nn::linear(&path / "cells", dim, channels * patch * patch, ZERO),
            channels,
            patch,
        }
    }

    /// `[1, C, H, W]`: the maximum of the ego's map and its neighbours' newest ones, weighted by the gate.
    ///
    /// # Shapes
    /// - `tokens`: of all entries, as input to the transformer
    /// - `context`: `[1, h, w, D]`, the ego's tokens after the transformer
    pub(super) fn maximum(
        &self,
        maps: &FineMaps,
        tokens: &Tokens,
        context: &Tensor,
    ) -> Result<Tensor, TchError> {
        let (own, neighbours) = (&maps.own, &maps.neighbours);
        let count = neighbours.count()?;
        if count == 0 {
            return f64_tensor::by_cell(own);
        }
        let others = channels_last(&tokens.values.f_narrow(0, 1, count)?)?;
        let weight = self.weight(&others, context)?;
        neighbours.maximum_with(own, &weight)
    }

    /// Weight of the neighbours' newest maps, token by token, 1 before training, 0 to 2 after: `[M, 1, H, W]` from their
    /// tokens `[M, h, w, D]` and the ego's after the transformer `[1, h, w, D]`.
    fn weight(&self, others: &Tensor, ego: &Tensor) -> Result<Tensor, TchError> {
        // A layer of both, side by side; the ego's part is the same for all others.
        let dim = ego.size4()?.3;
        let (ws, bs) = (&self.gate_hidden.ws, self.gate_hidden.bs.as_ref());
        let hidden = others.f_linear(&ws.f_narrow(1, 0, dim)?, None::<&Tensor>)?
            + ego.f_linear(&ws.f_narrow(1, dim, dim)?, bs)?;
        // The last layer is zero at first, of which the sigmoid is a half: the factor makes it 1.
        let weight = self.gate_out.forward(&hidden.f_relu()?).f_sigmoid()? * 2.0;
        let (maps, rows, columns, _) = weight.size4()?;
        let weight = weight.f_view([maps, 1, rows, columns])?;
        weight.f_upsample_nearest2d([rows * self.patch, columns * self.patch], None, None)
    }

    /// A map `[1, C, H, W]` with the additive change by the context, tokens `[1, h, w, D]`; the channels of a cell are
    /// contiguous in memory. Without a gradient `fused` is overwritten if its channels are last in memory.
    pub(super) fn changed(&self, fused: &Tensor, ego: &Tensor) -> Result<Tensor, TchError> {
        let (_, rows, columns, dim) = ego.size4()?;
        let (channels, patch) = (self.channels, self.patch);
        let bias = match &self.cells.bs {
            Some(bias) => Some(self.by_cell(bias, 1)?.f_squeeze_dim(1)?),
            None => None,
        };
        let cells = self
            .norm
            .forward(ego)
            .f_linear(&self.by_cell(&self.cells.ws, dim)?, bias.as_ref())?;
        let cells = cells
            .f_to_kind(Kind::Float)?
            .f_view([1, rows, columns, patch, patch, channels].as_slice())?;
        let fused = fused.f_permute([0, 2, 3, 1])?.f_contiguous()?;
        let mut by_patch = fused.f_view([1, rows, patch, columns, patch, channels].as_slice())?;
        // [1, h, w, p, p, C] to [1, h, p, w, p, C], the order of rows and columns of the map.
        let cells = cells.f_permute([0, 1, 3, 2, 4, 5])?;
        let changed = match are_numbers(&by_patch) && are_numbers(&cells) {
            true => by_patch.f_add_(&cells)?,
            false => by_patch.f_add(&cells)?,
        };
        changed
            .f_view([1, rows * patch, columns * patch, channels])?
            .f_permute([0, 3, 1, 2])
    }

    /// Weights of the last layer, `each` for a channel of a cell, in the order of cells and then channels. They are stored
    /// by channel and then by cell; transposing these few is cheaper than transposing the result.
    fn by_cell(&self, weights: &Tensor, each: i64) -> Result<Tensor, TchError> {
        weights
            .f_view([self.channels, self.patch * self.patch, each])?
            .f_transpose(0, 1)?
            .f_reshape([-1, each])
    }
}
