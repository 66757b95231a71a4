//! Encoder of V2X-ViT: layers of agent attention, window attention and a feed-forward network, all pre-norm.

use tch::{Tensor, nn};

use super::agent_attention::AgentAttention;
use super::config::V2xVitConfig;
use super::temporal_encoding::TemporalEncoding;
use super::window_attention::WindowAttention;
use crate::block_order::BlockOrder;
use crate::layers::{FeedForwardBlock, LayerNorm};

/// One pair of attentions, each with a residual.
#[derive(Debug)]
pub struct Block {
    agent_norm: LayerNorm,
    agents: AgentAttention,
    window_norm: LayerNorm,
    windows: WindowAttention,
}

impl Block {
    fn new(path: &nn::Path<'_>, config: &V2xVitConfig, order: &BlockOrder) -> Self {
        let channels = config.channels;
        let (heads, each) = (config.agent_heads, config.agent_head_channels);
        let (sizes, merge, dropout) = (&config.windows, config.merge, config.dropout);
        let (agents, cells) = (path / 0, path / 1);
        Self {
            agent_norm: LayerNorm::new(&(&agents / "norm"), channels),
            agents: AgentAttention::new(&(&agents / "fn"), channels, heads, each, dropout),
            window_norm: LayerNorm::new(&(&cells / "norm"), channels),
            windows: WindowAttention::new(&(&cells / "fn"), channels, sizes, merge, order, dropout),
        }
    }

    /// Across the agents at every cell: `[N, T, C]` to the output of the first `queries` of them.
    ///
    /// # Errors
    /// [`tch::TchError`] when shapes do not fit.
    pub fn across_agents(
        &self,
        x: &Tensor,
        unseen: Option<&Tensor>,
        types: &[usize],
        queries: usize,
        train: bool,
    ) -> tch::Result<Tensor> {
        let normed = self.agent_norm.forward(x)?;
        let seen = self
            .agents
            .forward(&normed, unseen, types, queries, train)?;
        (x.f_narrow(0, 0, queries as i64)? + seen).f_contiguous()
    }

    /// Across the cells of one agent, `[T, C]` to the same.
    ///
    /// # Errors
    /// [`tch::TchError`] when shapes do not fit.
    pub fn across_cells(&self, x: &Tensor, train: bool) -> tch::Result<Tensor> {
        Ok(x + self.windows.forward(&self.window_norm.forward(x)?, train)?)
    }
}

/// Blocks, then a feed-forward network.
#[derive(Debug)]
pub struct Layer {
    /// Its pairs of attentions.
    pub blocks: Vec<Block>,
    feed_forward: FeedForwardBlock,
}

/// The whole encoder, on tokens in the order of [`BlockOrder`].
#[derive(Debug)]
pub struct Encoder {
    /// The layers, first to last.
    pub layers: Vec<Layer>,
    /// Encoding of delays; absent where the configuration has none.
    pub temporal: Option<TemporalEncoding>,
}

impl Encoder {
    /// Variables `layers` and `rte` below `path`. `config` is valid and its order is `order`.
    pub fn new(path: &nn::Path<'_>, config: &V2xVitConfig, order: &BlockOrder) -> Self {
        let (channels, hidden, dropout) = (config.channels, config.hidden, config.dropout);
        let has_temporal = config.temporal_encoding;
        let temporal = has_temporal.then(|| TemporalEncoding::new(&(path / "rte"), channels));
        Self {
            layers: (0..config.depth)
                .map(|index| {
                    let path = path / "layers" / index;
                    let (blocks, feed) = (&path / 0 / "layers", &path / 1);
                    Layer {
                        blocks: (0..config.blocks)
                            .map(|block| Block::new(&(&blocks / block), config, order))
                            .collect(),
                        feed_forward: FeedForwardBlock::new(&feed, channels, hidden, dropout),
                    }
                })
                .collect(),
            temporal,
        }
    }

    /// Output of the ego, the first agent.
    ///
    /// Only the ego's output is used, so the last agent attention has the ego as its only query, and later steps are
    /// computed for the ego only.
    ///
    /// # Shapes
    /// - `x`: `[N, T, C]` maps on the ego's grid, delays encoded
    /// - `unseen`, `types`: as in [`AgentAttention::forward`]
    /// - returns: `[T, C]`
    ///
    /// # Errors
    /// [`tch::TchError`] when shapes do not fit.
    pub fn forward(
        &self,
        x: &Tensor,
        unseen: Option<&Tensor>,
        types: &[usize],
        train: bool,
    ) -> tch::Result<Tensor> {
        let mut x = x.shallow_clone();
        let attentions: usize = self.layers.iter().map(|layer| layer.blocks.len()).sum();
        let mut done = 0;
        for layer in &self.layers {
            for (index, block) in layer.blocks.iter().enumerate() {
                done += 1;
                // Nothing reads the neighbours' tokens after the last attention between agents.
                let queries = if done == attentions { 1 } else { types.len() };
                x = block.across_agents(&x, unseen, types, queries, train)?;
                let is_last = index + 1 == layer.blocks.len();
                x = each_agent(&x, |x| {
                    let x = block.across_cells(x, train)?;
                    match is_last {
                        true => layer.feed_forward.forward(&x, train),
                        false => Ok(x),
                    }
                })?;
            }
        }
        x.f_get(0)
    }
}

/// Applies `step` to each of `[N, T, C]`.
fn each_agent(x: &Tensor, step: impl Fn(&Tensor) -> tch::Result<Tensor>) -> tch::Result<Tensor> {
    let agents = (0..x.size3()?.0).map(|agent| step(&x.f_get(agent)?));
    match &agents.collect::<Result<Vec<_>, _>>()?[..] {
        [only] => only.f_unsqueeze(0),
        agents => Tensor::f_stack(agents, 0),
    }
}
