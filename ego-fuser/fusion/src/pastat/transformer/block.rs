//! The transformer's blocks: attention, then an MLP, both pre-norm with a residual (Eq. 8 and 9).

use tch::nn::{self, Module};
use tch::{Result, Tensor};

use super::attention::{AgentTimeAttention, MultiWindowAttention};
use crate::pastat::config::PastatConfig;
use crate::pastat::extensions::ego_queries::Others;

/// One block: over agents and time at each cell, across cells within windows, then cell by cell.
#[derive(Debug)]
pub(super) struct PastatBlock {
    norms: [nn::LayerNorm; 3],
    agents: AgentTimeAttention,
    windows: MultiWindowAttention,
    mlp: [nn::Linear; 2],
}

impl PastatBlock {
    pub(super) fn new(path: &nn::Path<'_>, config: &PastatConfig) -> Self {
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
    pub(super) fn forward(&self, tokens: &Tensor, valid: &Tensor) -> Result<Tensor> {
        let attended = self.agents.forward(&self.norms[0].forward(tokens), valid)?;
        let kept = attended + tokens.f_narrow(0, 0, 1)?;
        self.across(&kept, &valid.f_narrow(0, 0, 1)?)
    }

    /// The ego's newest `[1, h, w, D]` after this block, in plain floats: the result of
    /// [`forward`](Self::forward).
    pub(super) fn gather(&self, ego: &Tensor, others: &Others, valid: &Tensor) -> Result<Tensor> {
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
