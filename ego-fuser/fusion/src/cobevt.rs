//! CoBEVT: swap fusion of the agents' maps.
//!
//! Xu et al., CoRL 2022, with the LiDAR configuration of OpenCOOD. The reference numbers agents by the order in which they
//! come; here neighbours are numbered by their distance from the ego, so that the order in which messages arrive does not
//! matter. Its mean over the slots takes empty ones in too; networks that are trained here take the mean over those that
//! reach a cell, and need not compute the others. `count_missing` brings the published behaviour back.

use perception::model_config::ConfigError;
use serde::{Deserialize, Serialize};
use tch::nn;
use tch::{TchError, Tensor};

use super::padding::Padding;
use super::swap_fusion::{Slots, SwapFusion};
use super::{AlignedViews, Fusion};

/// Sizes of CoBEVT's fusion.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct CobevtConfig {
    /// Channels of the maps.
    pub channels: i64,
    /// Layers, each of window and grid attention.
    pub depth: usize,
    /// Agents that the table of offsets is made for.
    pub slots: i64,
    /// Cells along an edge of a window.
    pub window: i64,
    /// Channels of a head.
    pub head_channels: i64,
    /// Channels inside the feed-forward networks.
    pub hidden: i64,
    /// Whether empty slots are computed and count in the mean at the end: for published weights.
    pub count_missing: bool,
    /// Share of values left out in training.
    pub dropout: f64,
}

impl CobevtConfig {
    /// The published sizes, for maps of `channels` (256 there).
    #[must_use]
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

    /// For live traffic on two cores: two layers, heads as wide as the published ones, nothing left out
    /// (drawing what to leave out costs as much as a layer norm and a projection).
    #[must_use]
    pub fn lean(channels: i64) -> Self {
        Self { depth: 2, head_channels: (channels / 2).max(1), dropout: 0.0, ..Self::full(channels) }
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
        if let Some((field, size, _)) = sizes.into_iter().find(|(_, size, most)| !(1..=*most).contains(size)) {
            return Err(ConfigError::Value { field, value: size.to_string(), must: "at least 1 and not absurd" });
        }
        if self.channels % self.head_channels != 0 {
            let value = self.head_channels.to_string();
            return Err(ConfigError::Value { field: "fusion.head_channels", value, must: "a divisor of the channels" });
        }
        if !(0.0..1.0).contains(&self.dropout) {
            let value = self.dropout.to_string();
            return Err(ConfigError::Value { field: "fusion.dropout", value, must: "a share below 1" });
        }
        Ok(())
    }
}

/// The method behind the common interface.
#[derive(Debug)]
pub struct Cobevt {
    fusion: SwapFusion,
    window: i64,
    count_missing: bool,
}

impl Cobevt {
    /// Variables below `path`.
    ///
    /// # Errors
    /// [`ConfigError`] when no network can be built from `config`.
    pub fn new(path: &nn::Path<'_>, config: &CobevtConfig) -> Result<Self, ConfigError> {
        config.validate()?;
        let fusion = SwapFusion::new(path, config, true);
        Ok(Self { fusion, window: config.window, count_missing: config.count_missing })
    }
}

impl Fusion for Cobevt {
    fn fuse(&self, views: &AlignedViews<'_>, train: bool) -> Result<Tensor, TchError> {
        let agents = views.features.size4()?.0;
        let order = nearest_first(views);
        let [features, mask] = [views.features, views.mask].map(|maps| maps.f_index_select(0, &order));
        let (features, mask) = (features?, mask?);
        let sees_all = mask.f_min()?.f_double_value(&[])? > 0.0;
        let features = if sees_all { features } else { features * &mask };
        let empty = if self.count_missing { (self.fusion.slots() - agents).max(0) } else { 0 };
        let padding = Padding::to_multiples(&features, self.window)?;
        let features = padding.maps(&features, empty)?;
        let reach = if sees_all && empty == 0 && padding.is_empty() {
            None
        } else {
            Some(padding.mask(&mask, empty)?.f_squeeze_dim(1)?)
        };
        let slots = Slots { asked: agents, reach: reach.as_ref(), count_missing: self.count_missing };
        padding.crop(&self.fusion.forward(&features, slots, train)?)
    }
}

/// The numbers of the maps, the ego first and then by distance.
pub(super) fn nearest_first(views: &AlignedViews<'_>) -> Tensor {
    let distance = |index: &i64| {
        let [x, y, _] = views.facts[*index as usize].ego_from_cav.translation_m;
        if *index == 0 { -1.0 } else { x.hypot(y) }
    };
    let mut order: Vec<i64> = (0..views.facts.len() as i64).collect();
    order.sort_by(|one, other| distance(one).total_cmp(&distance(other)));
    Tensor::from_slice(&order).to_device(views.features.device())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_cannot_be_built_is_named() {
        assert!(CobevtConfig::full(256).validate().is_ok());
        assert!(CobevtConfig::lean(64).validate().is_ok());
        let message = |config: CobevtConfig| config.validate().unwrap_err().to_string();
        assert!(message(CobevtConfig { window: 0, ..CobevtConfig::lean(64) }).contains("fusion.window is 0"));
        assert!(message(CobevtConfig { head_channels: 24, ..CobevtConfig::lean(64) }).contains("divisor"));
    }
}
