//! Swap fusion (fused axial attention), the fusion of CoBEVT: attention over all agents within windows, then within
//! grids.
//!
//! A window is a square of neighbouring cells; a grid is as many cells spread evenly over the whole map. Tokens of both
//! are those of all agents; a bias table over the offset between agents, rows and columns is added to the scores.

use perception::model_config::ConfigError;
use protocol::config::{require, within};
use serde::{Deserialize, Serialize};
use tch::nn;
use tch::{Device, Kind, Tensor};

use super::f64_tensor::sum_over_first;
use super::layers::{FeedForwardBlock, LayerNorm, Linear, SMALL, attend, dropout, unseen};
use super::partition::{Partition, shape_error};

/// Tokens that are computed at once outside training: intermediate results then stay in the cache.
const CHUNK: i64 = 1280;

/// Sizes of swap fusion.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SwapFusionConfig {
    /// Channels of the maps.
    pub channels: i64,
    /// Layers, each of window and grid attention.
    pub depth: usize,
    /// Agents that the table of offsets covers.
    pub slots: i64,
    /// Cells along an edge of a window.
    pub window: i64,
    /// Channels of a head.
    pub head_channels: i64,
    /// Channels inside the feed-forward networks.
    pub hidden: i64,
    /// True if empty slots are computed and count in the mean at the end: for published weights.
    pub count_missing: bool,
    /// Share of values dropped in training.
    pub dropout: f64,
}

impl SwapFusionConfig {
    /// The published sizes, for feature maps of `channels` (256 there).
    pub fn full(channels: i64) -> Self {
        Self {
            channels,
            depth: 3,
            slots: 5,
            window: 4,
            head_channels: (channels / 8).max(1),
            hidden: channels,
            count_missing: false,
            dropout: 0.1,
        }
    }

    /// For live traffic on two cores: two layers, heads as wide as the published ones, no dropout (drawing its mask
    /// costs as much as a layer norm and a projection).
    pub fn lean(channels: i64) -> Self {
        Self {
            depth: 2,
            head_channels: (channels / 2).max(1),
            dropout: 0.0,
            ..Self::full(channels)
        }
    }

    /// Checks that a network can be built.
    ///
    /// # Errors
    /// [`ConfigError`] names the field, its value and what it must be.
    pub fn validate(&self) -> Result<(), ConfigError> {
        let sizes = [
            ("fusion.channels", self.channels, 4096),
            ("fusion.depth", self.depth as i64, 64),
            ("fusion.slots", self.slots, 64),
            ("fusion.window", self.window, 64),
            ("fusion.head_channels", self.head_channels, 4096),
            ("fusion.hidden", self.hidden, 4096),
        ];
        for (field, size, most) in sizes {
            within(field, size, 1, most)?;
        }
        let (field, size) = ("fusion.head_channels", self.head_channels);
        let rule = "must be a divisor of the channels";
        require(self.channels % size == 0, field, size, rule)?;
        let is_share = (0.0..1.0).contains(&self.dropout);
        let rule = "must be a share below 1";
        Ok(require(is_share, "fusion.dropout", self.dropout, rule)?)
    }
}

/// Learnt bias of the scores for the offset between two tokens of a group: agents, rows and columns.
#[derive(Debug)]
pub(super) struct OffsetTable {
    slots: i64,
    window: i64,
    pub(super) heads: i64,
    /// `[(2 * slots - 1) * (2 * window - 1)^2, M]`.
    table: Tensor,
}

impl OffsetTable {
    pub(super) fn new(path: &nn::Path<'_>, config: &SwapFusionConfig) -> Self {
        let heads = config.channels / config.head_channels;
        let offsets = (2 * config.slots - 1) * (2 * config.window - 1) * (2 * config.window - 1);
        let table = path / "relative_position_bias_table";
        Self {
            slots: config.slots,
            window: config.window,
            heads,
            table: table.var("weight", &[offsets, heads], SMALL),
        }
    }

    /// `[M, asking * cells, asked * cells]` added to the scores. Agents beyond the table's range use its last entry.
    pub(super) fn bias(&self, asking: i64, asked: i64) -> tch::Result<Tensor> {
        let (window, cells) = (self.window, self.window * self.window);
        let (span, last) = (2 * window - 1, self.slots - 1);
        let mut index = Vec::with_capacity((asking * cells * asked * cells) as usize);
        for from in 0..asking * cells {
            for to in 0..asked * cells {
                // Agents beyond the slots of the weights share the offset of the last slot.
                let agent = (from / cells - to / cells).clamp(-last, last) + last;
                let row = from % cells / window - to % cells / window + window - 1;
                let column = from % window - to % window + window - 1;
                index.push((agent * span + row) * span + column);
            }
        }
        let index = Tensor::f_from_slice(&index)?.f_to_device(self.table.device())?;
        let shape = [asking * cells, asked * cells, self.heads];
        let bias = self.table.f_index_select(0, &index)?.f_view(shape)?;
        bias.f_permute([2, 0, 1])?.f_contiguous()
    }

    /// The same of all `count` slots, with the mask of what they do not see: broadcastable to
    /// `[G, M, count * cells, asked * cells]`.
    pub(super) fn masked_bias(
        &self,
        count: i64,
        slots: Slots<'_>,
        partition: Partition,
    ) -> tch::Result<Tensor> {
        let bias = self.bias(count, slots.asked)?.f_unsqueeze(0)?;
        Ok(match slots.unseen(partition, self.window)? {
            Some(unseen) => bias + unseen,
            None => bias,
        })
    }
}

/// Attention among the tokens of a group and a feed-forward network, over one partition, each with pre-norm and a
/// residual.
#[derive(Debug)]
pub(super) struct HalfBlock {
    partition: Partition,
    norm: LayerNorm,
    to_qkv: Linear,
    offsets: OffsetTable,
    out: Linear,
    feed_forward: FeedForwardBlock,
    dropout: f64,
}

impl HalfBlock {
    pub(super) fn new(
        partition: Partition,
        attention: &nn::Path<'_>,
        feed: &nn::Path<'_>,
        config: &SwapFusionConfig,
    ) -> Self {
        let (channels, hidden) = (config.channels, config.hidden);
        let inner = attention / "fn";
        Self {
            partition,
            norm: LayerNorm::new(&(attention / "norm"), channels),
            to_qkv: Linear::new(&(&inner / "to_qkv"), channels, 3 * channels, false),
            offsets: OffsetTable::new(&inner, config),
            out: Linear::residual(&(&inner / "to_out" / 0), channels, channels, false),
            feed_forward: FeedForwardBlock::new(feed, channels, hidden, config.dropout),
            dropout: config.dropout,
        }
    }

    /// Attention alone: `[G, S, P, C]` to the same, of which the first `asked` slots are attended to.
    fn attend(&self, x: &Tensor, asked: i64, bias: &Tensor, train: bool) -> tch::Result<Tensor> {
        let &[_, slots, _, channels] = &x.size()[..] else {
            return Err(shape_error(x));
        };
        let by_head = [self.offsets.heads, channels / self.offsets.heads];
        let parts = if asked == slots {
            let parts = self.to_qkv.forward(x)?.f_flatten(1, 2)?;
            parts.f_split(channels, 2)?
        } else {
            // Slots that are not attended to have no keys and values.
            let weight = &self.to_qkv.weight;
            let query = x.f_linear(&weight.f_narrow(0, 0, channels)?, None::<Tensor>)?;
            let there = x.f_narrow(1, 0, asked)?.f_contiguous()?;
            let key_value =
                there.f_linear(&weight.f_narrow(0, channels, 2 * channels)?, None::<Tensor>)?;
            std::iter::once(query.f_flatten(1, 2)?)
                .chain(key_value.f_flatten(1, 2)?.f_split(channels, 2)?)
                .collect()
        };
        let [query, key, value] = [0, 1, 2].map(|part: usize| parts[part].f_unflatten(-1, by_head));
        let seen = attend(&query?, &key?, &value?, Some(bias))?;
        dropout(self.out.forward(&seen)?, self.dropout, train)?.f_view_as(x)
    }

    fn forward(&self, x: &Tensor, asked: i64, bias: &Tensor, train: bool) -> tch::Result<Tensor> {
        let seen = self.attend(&self.norm.forward(x)?, asked, bias, train)?;
        self.feed_forward.forward(&(x + seen), train)
    }

    /// On all groups of a map `[S, H, W, C]` at once, by operations with fast gradients: the groups.
    pub(super) fn whole(
        &self,
        map: &Tensor,
        slots: Slots<'_>,
        window: i64,
        train: bool,
    ) -> tch::Result<Tensor> {
        let x = self.partition.cut(map, window)?;
        let (offsets, count) = (&self.offsets, x.size()[1]);
        let bias = offsets.masked_bias(count, slots, self.partition)?;
        self.forward(&x, slots.asked, &bias, train)
    }
}

/// Validity of the slots.
#[derive(Debug, Clone, Copy)]
pub struct Slots<'a> {
    /// The first slots hold present agents; only those are attended to.
    pub asked: i64,
    /// `[S, H, W]` 1 where a map reaches, 0 elsewhere; absent: all reach everywhere.
    pub reach: Option<&'a Tensor>,
    /// True if slots that are empty, or do not reach a cell, count in the mean at the end, as they do in the reference.
    pub count_missing: bool,
}

impl Slots<'_> {
    /// `[G, 1, 1, asked * P]`: 0 for valid tokens, minus infinity for invalid ones.
    pub(super) fn unseen(&self, partition: Partition, window: i64) -> tch::Result<Option<Tensor>> {
        let Some(reach) = self.reach else {
            return Ok(None);
        };
        let unseen = unseen(&reach.f_narrow(0, 0, self.asked)?.f_unsqueeze(3)?)?;
        let shape = [-1, 1, 1, self.asked * window * window];
        Ok(Some(partition.cut(&unseen, window)?.f_view(shape)?))
    }
}

/// The mean over the slots, normalised and projected.
#[derive(Debug)]
pub(super) struct MeanHead {
    norm: LayerNorm,
    linear: Linear,
}

impl MeanHead {
    pub(super) fn new(path: &nn::Path<'_>, channels: i64) -> Self {
        Self {
            norm: LayerNorm::new(&(path / 2), channels),
            // Identity: the encoder's features are worth more than a random mixture of them.
            linear: Linear::identity(&(path / 3), channels),
        }
    }

    /// `[S, H, W, C]` to `[C, H, W]`.
    pub(super) fn forward(&self, x: &Tensor, slots: Slots<'_>) -> tch::Result<Tensor> {
        let mean = match slots.reach {
            Some(reach) if !slots.count_missing => {
                let reach = reach.f_unsqueeze(3)?.f_to_kind(x.kind())?;
                // At least 1, as the first slot reaches every cell.
                let count = sum_over_first(&reach)?;
                sum_over_first(&(x * reach))? / count
            }
            _ => x.f_mean_dim([0i64].as_slice(), false, None::<Kind>)?,
        };
        self.linear
            .forward(&self.norm.forward(&mean)?)?
            .f_permute([2, 0, 1])?
            .f_contiguous()
    }
}

/// The encoder of swap fusion.
#[derive(Debug)]
pub struct SwapFusion {
    /// Window and grid in turn.
    halves: Vec<HalfBlock>,
    head: MeanHead,
    window: i64,
}

impl SwapFusion {
    /// Variables `layers` and `mlp_head` below `path`. `config` is valid; `masked` selects which of the two networks of
    /// the reference the names belong to.
    pub fn new(path: &nn::Path<'_>, config: &SwapFusionConfig, masked: bool) -> Self {
        let mut halves = Vec::with_capacity(2 * config.depth);
        for layer in 0..config.depth {
            let path = path / "layers" / layer;
            let names = if masked {
                [
                    "window_attention",
                    "window_ffd",
                    "grid_attention",
                    "grid_ffd",
                ]
                .map(|name| &path / name)
            } else {
                [1, 2, 5, 6].map(|index| &path / "block" / index)
            };
            let [window, window_feed, grid, grid_feed] = &names;
            let window = HalfBlock::new(Partition::Window, window, window_feed, config);
            let grid = HalfBlock::new(Partition::Grid, grid, grid_feed, config);
            halves.extend([window, grid]);
        }
        Self {
            halves,
            head: MeanHead::new(&(path / "mlp_head"), config.channels),
            window: config.window,
        }
    }

    /// Fuses `[S, C, H, W]` into `[C, H, W]`. H and W are multiples of the window; the first slot reaches every cell.
    ///
    /// # Errors
    /// [`tch::TchError`] when shapes do not fit.
    pub fn forward(&self, maps: &Tensor, slots: Slots<'_>, train: bool) -> tch::Result<Tensor> {
        let x = self.through(maps, slots, self.halves.len(), train)?;
        self.head.forward(&x, slots)
    }

    /// All slots `[S, C, H, W]` after the first `layers` layers.
    ///
    /// # Errors
    /// [`tch::TchError`] when shapes do not fit.
    pub fn after_layers(
        &self,
        maps: &Tensor,
        slots: Slots<'_>,
        layers: usize,
    ) -> tch::Result<Tensor> {
        self.through(maps, slots, 2 * layers, false)?
            .f_permute([0, 3, 1, 2])?
            .f_contiguous()
    }

    /// All slots after the first `halves` half blocks: `[S, C, H, W]` to `[S, H, W, C]`.
    fn through(
        &self,
        maps: &Tensor,
        slots: Slots<'_>,
        halves: usize,
        train: bool,
    ) -> tch::Result<Tensor> {
        let mut x = maps.f_permute([0, 2, 3, 1])?.f_contiguous()?;
        let size = [x.size()[1], x.size()[2]];
        let as_map = |x: &Tensor, lies_in: Option<Partition>| match lies_in {
            Some(partition) => partition.map(x, size, self.window),
            None => Ok(x.shallow_clone()),
        };
        // Between two halves the tokens stay in the order of their groups; the next partition rearranges them.
        let mut lies_in = None;
        for half in &self.halves[..halves.min(self.halves.len())] {
            x = if train {
                half.whole(&as_map(&x, lies_in)?, slots, self.window, true)?
            } else {
                self.chunked(half, &x, lies_in, slots, size)?
            };
            lies_in = Some(half.partition);
        }
        as_map(&x, lies_in)
    }

    /// The same some groups at a time, gathered from their places in memory.
    fn chunked(
        &self,
        half: &HalfBlock,
        x: &Tensor,
        lies_in: Option<Partition>,
        slots: Slots<'_>,
        size: [i64; 2],
    ) -> tch::Result<Tensor> {
        let channels = x.size()[3];
        let rows = x.f_view([-1, channels])?;
        let total = rows.size()[0];
        let cells = self.window * self.window;
        let count = total / (size[0] * size[1]);
        // Indices are rearranged instead of features: each chunk then gathers its rows once.
        let order = Tensor::f_arange(total, (Kind::Int64, Device::Cpu))?.f_to_device(x.device())?;
        let order = match lies_in {
            Some(partition) => {
                partition.map(&order.f_view([-1, count, cells, 1])?, size, self.window)?
            }
            None => order.f_view([count, size[0], size[1], 1])?,
        };
        let order = half.partition.cut(&order, self.window)?.f_view([-1])?;
        let bias = half.offsets.bias(count, slots.asked)?.f_unsqueeze(0)?;
        let unseen = slots.unseen(half.partition, self.window)?;
        let step = (CHUNK / (count * cells)).max(1);
        let mut done = Vec::new();
        for (index, order) in order.f_split(step * count * cells, 0)?.iter().enumerate() {
            let x = rows
                .f_index_select(0, order)?
                .f_view([-1, count, cells, channels])?;
            let biased = match &unseen {
                Some(unseen) => Some(&bias + unseen.f_narrow(0, index as i64 * step, x.size()[0])?),
                None => None,
            };
            done.push(half.forward(&x, slots.asked, biased.as_ref().unwrap_or(&bias), false)?);
        }
        Tensor::f_cat(&done, 0)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn invalid_settings_are_named() {
        assert!(SwapFusionConfig::full(256).validate().is_ok());
        assert!(SwapFusionConfig::lean(64).validate().is_ok());
        let no_window = SwapFusionConfig {
            window: 0,
            ..SwapFusionConfig::lean(64)
        };
        let uneven_heads = SwapFusionConfig {
            head_channels: 24,
            ..SwapFusionConfig::lean(64)
        };
        for (config, part) in [(no_window, "fusion.window is 0"), (uneven_heads, "divisor")] {
            let message = config.validate().unwrap_err().to_string();
            assert!(message.contains(part), "{message}");
        }
    }
}
