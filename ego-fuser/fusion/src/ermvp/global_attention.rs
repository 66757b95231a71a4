//! Window attention with global queries: queries summarise the whole feature map and are the same for all windows.

use tch::{Kind, Result, Tensor, nn};

use crate::layers::{FeedForwardBlock, LayerNorm, Linear, attend, dropout};
use crate::partition::{Partition, shape_error};
use crate::swap_fusion::{OffsetTable, Slots, SwapFusionConfig};

/// Share of the channels inside a squeeze.
const SQUEEZE: i64 = 4;
/// Reduction of the feature map that the queries are computed from, along an edge.
pub(super) const REDUCTION: i64 = 4;

/// A depthwise convolution with squeeze and excitation, added to its input, then half the resolution.
#[derive(Debug)]
struct Extract {
    depthwise: Tensor,
    squeeze: Linear,
    excite: Linear,
    mix: Linear,
}

impl Extract {
    fn new(path: &nn::Path<'_>, channels: i64) -> Self {
        let (compressed, kernel) = ((channels / SQUEEZE).max(1), [channels, 1, 3, 3]);
        let path = path / "conv";
        Self {
            depthwise: (&path / 0).var("weight", &kernel, nn::init::DEFAULT_KAIMING_UNIFORM),
            squeeze: Linear::new(&(&path / 2 / "fc" / 0), channels, compressed, false),
            excite: Linear::new(&(&path / 2 / "fc" / 2), compressed, channels, false),
            mix: Linear::residual(&(&path / 3), channels, channels, false),
        }
    }

    /// `[S, C, H, W]` to `[S, C, H / 2, W / 2]`.
    fn forward(&self, x: &Tensor) -> Result<Tensor> {
        let channels = x.size4()?.1;
        let one = [1i64, 1];
        let seen = x
            .f_conv2d(&self.depthwise, None::<Tensor>, one, one, one, channels)?
            .f_gelu("none")?;
        // Squeeze and excitation: a gate for each channel, from the mean over the map.
        let mean = seen.f_mean_dim([2i64, 3].as_slice(), false, None::<Kind>)?;
        let squeezed = self.squeeze.forward(&mean)?.f_gelu("none")?;
        let gate = self.excite.forward(&squeezed)?.f_sigmoid()?;
        let seen = seen * gate.f_unsqueeze(2)?.f_unsqueeze(3)?;
        let mixed = self.mix.forward(&seen.f_permute([0, 2, 3, 1])?)?;
        (x + mixed.f_permute([0, 3, 1, 2])?).f_max_pool2d([3i64, 3], [2i64, 2], one, one, false)
    }
}

/// The half block: global queries, local keys and values, then a feed-forward network.
#[derive(Debug)]
pub(super) struct GlobalHalf {
    norm: LayerNorm,
    extract: [Extract; 2],
    key_value: Linear,
    offsets: OffsetTable,
    out: Linear,
    feed_forward: FeedForwardBlock,
    window: i64,
    dropout: f64,
}

impl GlobalHalf {
    /// Variables `WindowAttentionGlobal` and `windowGlobal_ffd` below `path`.
    pub(super) fn new(path: &nn::Path<'_>, config: &SwapFusionConfig) -> Self {
        let (attention, feed) = (path / "WindowAttentionGlobal", path / "windowGlobal_ffd");
        let inner = &attention / "fn";
        let (channels, hidden) = (config.channels, config.hidden);
        Self {
            norm: LayerNorm::new(&(&attention / "norm"), channels),
            extract: std::array::from_fn(|index| {
                Extract::new(&(&inner / "to_q_global" / index), channels)
            }),
            key_value: Linear::new(&(&inner / "qkv"), channels, 2 * channels, true),
            offsets: OffsetTable::new(&inner, config),
            out: Linear::residual(&(&inner / "to_out" / 0), channels, channels, false),
            feed_forward: FeedForwardBlock::new(&feed, channels, hidden, config.dropout),
            window: config.window,
            dropout: config.dropout,
        }
    }

    /// A feature map `[S, H, W, C]` to the same. H and W are multiples of [`REDUCTION`] windows.
    pub(super) fn forward(&self, map: &Tensor, slots: Slots<'_>, train: bool) -> Result<Tensor> {
        let &[count, height, width, channels] = &map.size()[..] else {
            return Err(shape_error(map));
        };
        let x = self.norm.forward(map)?;
        let query = self.queries(&x, slots)?;
        let groups = Partition::Window.cut(&x, self.window)?;
        let windows = groups.size()[0];
        let by_head = [self.offsets.heads, channels / self.offsets.heads];
        let query = query.f_unflatten(-1, by_head)?;
        let query = query.f_expand([windows, -1, -1, -1], false)?;
        let key_value = self.key_value.forward(&groups)?;
        let key_value = key_value.f_view([windows, -1, 2 * channels])?;
        let parts = key_value.f_split(channels, 2)?;
        let [key, value] = [0, 1].map(|part: usize| parts[part].f_unflatten(-1, by_head));
        let bias = self.offsets.masked_bias(count, slots, Partition::Window)?;
        let seen = attend(&query, &key?, &value?, Some(&bias))?;
        let seen = dropout(self.out.forward(&seen)?, self.dropout, train)?.f_view_as(&groups)?;
        let x = map + Partition::Window.map(&seen, [height, width], self.window)?;
        self.feed_forward.forward(&x, train)
    }

    /// One query for each token of a window, `[1, S * P, C]`: the mean over all windows of a smaller feature map after
    /// self-attention among the tokens of each window.
    fn queries(&self, x: &Tensor, slots: Slots<'_>) -> Result<Tensor> {
        let small = x.f_permute([0, 3, 1, 2])?.f_contiguous()?;
        let small = self.extract[1]
            .forward(&self.extract[0].forward(&small)?)?
            .f_permute([0, 2, 3, 1])?
            .f_contiguous()?;
        let groups = Partition::Window.cut(&small, self.window)?;
        let channels = groups.size()[3];
        let tokens = groups.f_view([groups.size()[0], -1, 1, channels])?;
        let small_reach = slots.reach.map(|reach| {
            // A cell of the small feature map is valid where any of its cells is.
            let (reach, step) = (reach.f_unsqueeze(1)?, [REDUCTION, REDUCTION]);
            let reach = reach.f_max_pool2d(step, step, [0i64, 0], [1i64, 1], false)?;
            reach.f_squeeze_dim(1)
        });
        let small_reach = small_reach.transpose()?;
        let reach = small_reach.as_ref();
        let unseen = Slots { reach, ..slots }.unseen(Partition::Window, self.window)?;
        let seen = attend(&tokens, &tokens, &tokens, unseen.as_ref())?;
        seen.f_mean_dim([0i64].as_slice(), true, None::<Kind>)
    }
}
