//! Configuration of a V2X-ViT encoder.

use perception::model_config::ConfigError;
use protocol::config::{FieldError, require, within};
use serde::{Deserialize, Serialize};

use crate::block_order::BlockOrder;

/// Attention within windows of one size.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct WindowConfig {
    /// Cells along an edge.
    pub edge: i64,
    /// Heads.
    pub heads: i64,
    /// Channels of a head.
    pub head_channels: i64,
}

/// Merge of the outputs of window attention of several sizes.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Merge {
    /// Their mean.
    Naive,
    /// Weighted mean; the weights per channel come from the mean over the map.
    SplitAttention,
}

/// Sizes of a V2X-ViT encoder.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct V2xVitConfig {
    /// Channels of the maps.
    pub channels: i64,
    /// Layers, each of `blocks` pairs of agent and window attention and a feed-forward network.
    pub depth: usize,
    /// Pairs of agent and window attention in a layer.
    pub blocks: usize,
    /// Heads of the agent attention.
    pub agent_heads: i64,
    /// Channels of a head of the agent attention.
    pub agent_head_channels: i64,
    /// Window attention, one entry a size; the edges divide one another.
    pub windows: Vec<WindowConfig>,
    /// Merge of the sizes.
    pub merge: Merge,
    /// Channels inside the feed-forward network.
    pub hidden: i64,
    /// True if the delay of an agent is encoded in its features.
    pub temporal_encoding: bool,
    /// Share of values dropped in training.
    pub dropout: f64,
}

impl V2xVitConfig {
    /// The published sizes, for feature maps of `channels` (256 there).
    pub fn full(channels: i64) -> Self {
        Self {
            channels,
            depth: 3,
            blocks: 1,
            agent_heads: 8,
            agent_head_channels: (channels / 8).max(1),
            windows: windows(channels, [(4, 16), (8, 8), (16, 4)]),
            merge: Merge::SplitAttention,
            hidden: channels,
            temporal_encoding: true,
            dropout: 0.3,
        }
    }

    /// For live traffic on two cores: two layers, heads as wide as the published ones, no dropout (drawing its mask
    /// costs as much as a layer norm and a projection).
    pub fn lean(channels: i64) -> Self {
        Self {
            depth: 2,
            agent_heads: 2,
            agent_head_channels: (channels / 2).max(1),
            windows: windows(channels, [(4, 4), (8, 2), (16, 1)]),
            dropout: 0.0,
            ..Self::full(channels)
        }
    }

    /// The order of tokens that all its windows need.
    ///
    /// # Errors
    /// [`ConfigError`] when the edges do not divide one another.
    pub fn order(&self) -> Result<BlockOrder, ConfigError> {
        let edges: Vec<i64> = self.windows.iter().map(|window| window.edge).collect();
        BlockOrder::new(&edges).ok_or_else(|| {
            let rule = "must be edges of which each divides the next larger one";
            FieldError::new("fusion.windows.edge", format_args!("{edges:?}"), rule).into()
        })
    }

    /// Checks that an encoder can be built.
    ///
    /// # Errors
    /// [`ConfigError`] names the field, its value and what it must be.
    pub fn validate(&self) -> Result<(), ConfigError> {
        let mut sizes = vec![
            ("fusion.channels", self.channels),
            ("fusion.agent_heads", self.agent_heads),
            ("fusion.agent_head_channels", self.agent_head_channels),
            ("fusion.hidden", self.hidden),
            ("fusion.depth", self.depth as i64),
            ("fusion.blocks", self.blocks as i64),
        ];
        for window in &self.windows {
            sizes.push(("fusion.windows.heads", window.heads));
            sizes.push(("fusion.windows.head_channels", window.head_channels));
        }
        for (field, size) in sizes {
            within(field, size, 1, 4096)?;
        }
        within("fusion.windows.edge", self.order()?.largest(), 1, 64)?;
        let is_share = (0.0..1.0).contains(&self.dropout);
        let rule = "must be a share below 1";
        Ok(require(is_share, "fusion.dropout", self.dropout, rule)?)
    }
}

/// Windows given by edge and heads; the heads of each share `channels`.
fn windows(channels: i64, sizes: [(i64, i64); 3]) -> Vec<WindowConfig> {
    let windows = sizes.map(|(edge, heads)| WindowConfig {
        edge,
        heads,
        head_channels: (channels / heads).max(1),
    });
    windows.into()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn message_after(change: fn(&mut V2xVitConfig)) -> String {
        let mut config = V2xVitConfig::lean(64);
        change(&mut config);
        config.validate().unwrap_err().to_string()
    }

    #[test]
    fn invalid_settings_are_named() {
        assert!(V2xVitConfig::full(256).validate().is_ok());
        assert!(V2xVitConfig::lean(64).validate().is_ok());
        assert!(message_after(|config| config.windows[0].edge = 3).contains("[3, 8, 16]"));
        assert!(message_after(|config| config.windows.clear()).contains("windows.edge"));
        assert!(message_after(|config| config.depth = 0).contains("fusion.depth is 0"));
        assert!(message_after(|config| config.dropout = 1.0).contains("fusion.dropout"));
    }
}
