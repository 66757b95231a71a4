//! Cells to tokens and back.

use tch::nn::{self, Init, Module};
use tch::{Kind, TchError, Tensor};

use super::config::PastatConfig;
use super::precision::fastest_of;
use super::temporal::encoding;

/// Patches of cells to tokens, with what is known of a map beside what it shows.
#[derive(Debug)]
pub(super) struct Tokeniser {
    patches: nn::Conv2D,
    /// `[D]`: the weight of Eq. 7's channel. That channel has one value all over a map, so its part of a token is this
    /// times that value, whichever cells the token is of; the channel itself need not be built.
    confidence: Option<Tensor>,
    config: PastatConfig,
}

impl Tokeniser {
    pub(super) fn new(path: &nn::Path<'_>, config: &PastatConfig) -> Self {
        let PastatConfig { channels, dim, patch, .. } = *config;
        let stride = nn::ConvConfig { stride: patch, ..Default::default() };
        let deviation = ((channels * patch * patch) as f64).sqrt().recip();
        let random = Init::Uniform { lo: -deviation, up: deviation };
        Self {
            patches: nn::conv2d(path / "patches", channels, dim, patch, stride),
            confidence: config.ce.then(|| (path / "ce").var("weight", &[dim], random)),
            config: config.clone(),
        }
    }

    /// What tokens see of maps `[N, C, H, W]`: `[N, D, h, w]`; each cell of the maps is one of `cells` by `cells`.
    pub(super) fn seen(&self, maps: &Tensor, cells: i64) -> Result<Tensor, TchError> {
        let Self { patches: nn::Conv2D { ws, bs, .. }, config, .. } = self;
        let edge = config.patch / cells;
        // As if each of the cells that were taken together showed their mean.
        let weight = match cells {
            1 => ws.shallow_clone(),
            _ => ws.f_avg_pool2d([cells, cells], [cells, cells], [0_i64, 0], false, true, None::<i64>)?,
        };
        let weight = weight * (cells * cells) as f64;
        let kind = fastest_of(maps);
        let bias = bs.as_ref().map(|bias| bias.f_to_kind(kind)).transpose()?;
        let (maps, weight) = (maps.f_to_kind(kind)?, weight.f_to_kind(kind)?);
        maps.f_conv2d(&weight, bias.as_ref(), [edge, edge], [0, 0], [1, 1], 1)?.f_to_kind(Kind::Float)
    }

    /// What tokens are told of the map that they are of, `[N, D]`: its share of all trust (CE) and its age (TE).
    pub(super) fn facts(&self, shares: &[f32], age_secs: &[f64]) -> Result<Tensor, TchError> {
        let (entries, device) = (shares.len() as i64, self.patches.ws.device());
        let facts = match self.config.te {
            Some(wavelengths) => {
                let values: Vec<f32> =
                    age_secs.iter().flat_map(|&age| encoding(age, &self.config, wavelengths)).collect();
                Tensor::f_from_slice(&values)?.f_view([entries, self.config.dim])?.f_to_device(device)?
            }
            None => Tensor::f_zeros([entries, self.config.dim], (Kind::Float, device))?,
        };
        match &self.confidence {
            Some(weight) => Ok(facts + Tensor::f_from_slice(shares)?.f_to_device(device)?.f_unsqueeze(1)? * weight),
            None => Ok(facts),
        }
    }

    /// `[N, h, w]`: 1 for tokens of which any cell is valid in the mask `[N, 1, H, W]`, a cell of which is one of `cells` by
    /// `cells`.
    pub(super) fn valid(&self, mask: &Tensor, cells: i64) -> Result<Tensor, TchError> {
        let edge = self.config.patch / cells;
        let none: [i64; 2] = [0, 0];
        mask.f_max_pool2d([edge, edge], [edge, edge], none, [1, 1], false)?.f_squeeze_dim(1)
    }
}

/// How much of a neighbour's newest map is taken, token by token: 1 before it is trained, 0 to 2 after.
#[derive(Debug)]
pub(super) struct TrustGate {
    hidden: nn::Linear,
    out: nn::Linear,
    patch: i64,
}

impl TrustGate {
    pub(super) fn new(path: &nn::Path<'_>, config: &PastatConfig) -> Self {
        let neutral = nn::LinearConfig { ws_init: Init::Const(0.0), bs_init: Some(Init::Const(0.0)), bias: true };
        Self {
            hidden: nn::linear(path / "hidden", 2 * config.dim, config.dim, nn::LinearConfig::default()),
            out: nn::linear(path / "out", config.dim, 1, neutral),
            patch: config.patch,
        }
    }

    /// `[M, 1, H, W]` from the neighbours' tokens `[M, h, w, D]` and the ego's after the transformer `[1, h, w, D]`.
    pub(super) fn forward(&self, others: &Tensor, ego: &Tensor) -> Result<Tensor, TchError> {
        // A layer of both, side by side; the ego's part is the same for all others.
        let dim = ego.size4()?.3;
        let part = |first: i64| self.hidden.ws.f_narrow(1, first, dim);
        let hidden =
            others.f_linear(&part(0)?, None::<&Tensor>)? + ego.f_linear(&part(dim)?, self.hidden.bs.as_ref())?;
        let trust = self.out.forward(&hidden.f_relu()?).f_sigmoid()? * 2.0;
        let (maps, rows, columns, _) = trust.size4()?;
        let trust = trust.f_view([maps, 1, rows, columns])?;
        trust.f_upsample_nearest2d([rows * self.patch, columns * self.patch], None, None)
    }
}

/// Tokens back to cells: what the transformer adds to a map; nothing before it is trained.
#[derive(Debug)]
pub(super) struct Decoder {
    norm: nn::LayerNorm,
    cells: nn::Linear,
    channels: i64,
    patch: i64,
}

impl Decoder {
    pub(super) fn new(path: &nn::Path<'_>, config: &PastatConfig) -> Self {
        let PastatConfig { channels, dim, patch, .. } = *config;
        let neutral = nn::LinearConfig { ws_init: Init::Const(0.0), bs_init: Some(Init::Const(0.0)), bias: true };
        Self {
            norm: nn::layer_norm(path / "norm", vec![dim], nn::LayerNormConfig::default()),
            cells: nn::linear(path / "cells", dim, channels * patch * patch, neutral),
            channels,
            patch,
        }
    }

    /// `[1, C, H, W]` of tokens `[1, h, w, D]`, the channels of a cell side by side in memory.
    pub(super) fn forward(&self, ego: &Tensor) -> Result<Tensor, TchError> {
        let (_, rows, columns, dim) = ego.size4()?;
        let Self { channels, patch, .. } = *self;
        // Weights are kept by channel and then by cell; few as they are, they are cheaper to turn than what they make.
        let by_cell = |weights: &Tensor, each: i64| {
            weights.f_view([channels, patch * patch, each])?.f_transpose(0, 1)?.f_reshape([-1, each])
        };
        let bias = self.cells.bs.as_ref().map(|bias| by_cell(bias, 1)?.f_squeeze_dim(1)).transpose()?;
        let cells = self.norm.forward(ego).f_linear(&by_cell(&self.cells.ws, dim)?, bias.as_ref())?;
        let cells = cells.f_to_kind(Kind::Float)?.f_view([1, rows, columns, patch, patch, channels].as_slice())?;
        let cells = cells.f_permute([0, 1, 3, 2, 4, 5])?.f_reshape([1, rows * patch, columns * patch, channels])?;
        cells.f_permute([0, 3, 1, 2])
    }
}
