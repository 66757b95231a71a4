//! Patch embedding (the Flatten of Eq. 10): squares of cells to tokens.

use tch::{TchError, Tensor, nn};

use super::coarse_alignment::CoarseMaps;
use super::config::PastatConfig;
use crate::warp::WarpedMaps;

/// Linear embedding of patches of cells.
#[derive(Debug)]
pub(super) struct Patches {
    convolution: nn::Conv2D,
    patch: i64,
    /// Cells along each edge of a cell of earlier maps.
    earlier_cells: i64,
}

/// Tokens of maps, the ego's newest first.
#[derive(Debug)]
pub(super) struct Tokens {
    /// `[N, D, h, w]`.
    pub(super) values: Tensor,
    /// `[N, h, w]`: 1 for tokens of which any cell is valid.
    pub(super) valid: Tensor,
}

impl Patches {
    /// Its variables are `patches.*` below `path`.
    pub(super) fn new(path: &nn::Path<'_>, config: &PastatConfig) -> Self {
        let (channels, dim, patch) = (config.channels, config.dim, config.patch);
        let stride = nn::ConvConfig {
            stride: patch,
            ..Default::default()
        };
        Self {
            convolution: nn::conv2d(path / "patches", channels, dim, patch, stride),
            patch,
            earlier_cells: config.earlier_cells,
        }
    }

    /// Tokens of the newest maps, then of the earlier ones; before encodings are added.
    pub(super) fn flatten(&self, maps: &CoarseMaps) -> Result<Tokens, TchError> {
        let newest = &maps.newest;
        let mut values = self.values(&newest.features, 1)?;
        let mut valid = self.valid(&newest.mask, 1)?;
        if let Some(WarpedMaps { features, mask }) = &maps.earlier {
            values = Tensor::f_cat(&[values, self.values(features, self.earlier_cells)?], 0)?;
            valid = Tensor::f_cat(&[valid, self.valid(mask, self.earlier_cells)?], 0)?;
        }
        Ok(Tokens { values, valid })
    }

    /// `[N, D, h, w]` of maps `[N, C, H, W]`, each cell of which is one of `cells` by `cells`.
    fn values(&self, maps: &Tensor, cells: i64) -> Result<Tensor, TchError> {
        let nn::Conv2D { ws, bs, .. } = &self.convolution;
        let edge = self.patch / cells;
        // Equal to all pooled cells showing their mean.
        let (edges, none) = ([cells; 2], [0_i64; 2]);
        let weight = match cells {
            1 => ws.shallow_clone(),
            _ => ws.f_avg_pool2d(edges, edges, none, false, true, None::<i64>)?,
        };
        let weight = weight * (cells * cells) as f64;
        maps.f_conv2d(&weight, bs.as_ref(), [edge, edge], [0, 0], [1, 1], 1)
    }

    /// `[N, h, w]`: 1 for tokens of which any cell is valid in the mask `[N, 1, H, W]`, whose cells are pooled from
    /// `cells` by `cells`.
    fn valid(&self, mask: &Tensor, cells: i64) -> Result<Tensor, TchError> {
        let edge = self.patch / cells;
        let none: [i64; 2] = [0, 0];
        mask.f_max_pool2d([edge, edge], [edge, edge], none, [1, 1], false)?
            .f_squeeze_dim(1)
    }
}

/// Tokens `[N, D, h, w]` with their channels last.
pub(super) fn channels_last(tokens: &Tensor) -> Result<Tensor, TchError> {
    tokens.f_permute([0, 2, 3, 1])?.f_contiguous()
}
