//! Vision transformer (Eq. 8, 9): attention over agents and time at each cell and within windows, then an MLP, in
//! pre-norm blocks.
//!
//! Full attention over all cells of all maps is too expensive. As in V2X-ViT, tokens attend over agents and time at
//! each cell, and across cells within windows of several sizes.

mod attention;
mod window_loops;

use tch::nn::{self, Module};
use tch::{Device, Result, Tensor};

use self::attention::{AgentTimeAttention, MultiWindowAttention};
use super::config::PastatConfig;
use super::extensions::ego_queries::Others;
use super::patches::{Tokens, channels_last};

/// The blocks of the transformer.
#[derive(Debug)]
pub(super) struct Transformer {
    blocks: Vec<PastatBlock>,
}

impl Transformer {
    /// Its variables are `blocks.*` below `path`.
    pub(super) fn new(path: &nn::Path<'_>, config: &PastatConfig) -> Self {
        Self {
            blocks: (0..config.depth)
                .map(|index| PastatBlock::new(&(path / "blocks" / index), config))
                .collect(),
        }
    }

    /// Context of the ego: its tokens `[1, h, w, D]` after all blocks.
    pub(super) fn forward(&self, Tokens { values, valid }: &Tokens) -> Result<Tensor> {
        // Only the ego's tokens change from block to block: the others are prepared once and never projected.
        if values.device() == Device::Cpu && !values.requires_grad() {
            let (others, valid) = (Others::of(values, valid)?, valid.f_narrow(0, 0, 1)?);
            let ego = channels_last(&values.f_narrow(0, 0, 1)?)?;
            return self
                .blocks
                .iter()
                .try_fold(ego, |ego, block| block.gather(&ego, &others, &valid));
        }
        let mut tokens = channels_last(values)?;
        let others = tokens.f_narrow(0, 1, tokens.size()[0] - 1)?;
        for block in &self.blocks {
            let ego = block.forward(&tokens, valid)?;
            tokens = Tensor::f_cat(&[&ego, &others], 0)?;
        }
        tokens.f_narrow(0, 0, 1)
    }
}

/// One block, attention and then an MLP, both pre-norm with a residual (Eq. 8 and 9): over agents and time at each cell, across cells within windows, then cell by cell.
#[derive(Debug)]
struct PastatBlock {
    norms: [nn::LayerNorm; 3],
    agents: AgentTimeAttention,
    windows: MultiWindowAttention,
    mlp: [nn::Linear; 2],
}

impl PastatBlock {
    fn new(path: &nn::Path<'_>, config: &PastatConfig) -> Self {
        let (dim, heads) = (config.dim, config.heads);
        let wide = config.mlp_ratio * dim;
        Self {
            norms: ["norm_agents", "norm_windows", "norm_mlp"]
                .map(|name| nn::layer_norm(path / name, vec![dim], nn::LayerNormConfig::default())),
            agents: AgentTimeAttention::new(&(path / "agents"), dim, heads),
            windows: MultiWindowAttention::new(&(path / "windows"), dim, heads, &config.windows),
            mlp: [("mlp0", dim, wide), ("mlp1", wide, dim)].map(|(name, from, to)| {
                nn::linear(path / name, from, to, nn::LinearConfig::default())
            }),
        }
    }

    /// The ego's newest after this block.
    ///
    /// # Shapes
    /// - `tokens`: `[N, h, w, D]`, the ego's newest first
    /// - `valid`: `[N, h, w]`
    /// - returns: `[1, h, w, D]`
    fn forward(&self, tokens: &Tensor, valid: &Tensor) -> Result<Tensor> {
        let attended = self.agents.forward(&self.norms[0].forward(tokens), valid)?;
        let kept = attended + tokens.f_narrow(0, 0, 1)?;
        self.across(&kept, &valid.f_narrow(0, 0, 1)?)
    }

    /// The ego's newest `[1, h, w, D]` after this block, in plain floats: the result of
    /// [`forward`](Self::forward).
    fn gather(&self, ego: &Tensor, others: &Others, valid: &Tensor) -> Result<Tensor> {
        let kept = self.agents.gather(&self.norms[0], ego, others)? + ego;
        self.across(&kept, valid)
    }

    /// Second half of the block, after the attention over agents and time: across cells, and cell by cell.
    fn across(&self, kept: &Tensor, valid: &Tensor) -> Result<Tensor> {
        let [_, norm_windows, norm_mlp] = &self.norms;
        let kept = self.windows.forward(&norm_windows.forward(kept), valid)? + kept;
        let inner = self.mlp[0].forward(&norm_mlp.forward(&kept));
        let inner = inner.f_gelu("none")?;
        Ok(self.mlp[1].forward(&inner) + kept)
    }
}
