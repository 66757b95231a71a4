//! ERMVP: selection of cells, pose correction by consensus among them, attention with local and global queries.
//!
//! Zhang et al., CVPR 2024. The characteristic steps are kept: cells are sampled by a learnt score, consensus among
//! sampled cells moves a neighbour's feature map before it is fused, and each layer attends within windows with queries
//! of the window and then with queries that summarise the whole feature map. Simplifications, and their cost:
//!
//! - Similar cells among the sampled ones are not merged into clusters. Merging saves bytes and loses detail (the
//!   published code computes it and fuses without it), so a message is larger here than the paper's, and the fused map
//!   not worse.
//! - Cells are sampled by the ego from feature maps that were received completely. The fused cells are those that would
//!   have been sent; the traffic is that of complete feature maps. A sender could leave out all cells but the share
//!   `kept`.
//! - The correction is a soft search around each sampled cell and a closed-form fit. It reaches `search` cells and no
//!   further; matching over the whole feature map may correct larger errors, or find a wrong match.
//! - Queries from the whole feature map attend with the usual scale inside the softmax; the published code scales after
//!   it, which makes its attention almost uniform. Missing neighbours are masked there too, so that they change
//!   nothing.
//! - The mean at the end is taken over the maps that reach a cell, and there is no second loss on the ego-only map.

mod consensus;
mod global_attention;
mod sampling;

use perception::model_config::{ConfigError, DetectorConfig};
use protocol::config::{require, within};
use serde::{Deserialize, Serialize};
use tch::{TchError, Tensor, nn};

use self::consensus::FeatureConsensus;
use self::global_attention::{GlobalHalf, REDUCTION};
use self::sampling::Sampler;
use super::cobevt::nearest_first;
use super::padding::Padding;
use super::partition::Partition;
use super::settings::of_size;
use super::swap_fusion::{HalfBlock, MeanHead, Slots, SwapFusionConfig};
use super::warp::WarpedMaps;
use crate::{AlignedMaps, Fusion, FusionOutput, FusionSettings, MethodSpec};

/// ERMVP.
pub static METHOD: MethodSpec = MethodSpec::of_features::<ErmvpConfig>(
    "feature maps, the cells worth sending, poses corrected by consensus among them (ERMVP)",
);

/// Sizes of ERMVP.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ErmvpConfig {
    /// The layers; each has attention within windows twice, with local and with global queries.
    pub layers: SwapFusionConfig,
    /// Share of a neighbour's cells that are kept.
    pub kept: f64,
    /// Number of cells that are compared to estimate the offset of a neighbour's feature map.
    pub compared: i64,
    /// Search range to each side of such a cell, cells.
    pub search: i64,
}

impl ErmvpConfig {
    /// The published sizes, for feature maps of `channels` (256 there).
    pub fn full(channels: i64) -> Self {
        Self {
            layers: SwapFusionConfig::full(channels),
            kept: 0.2,
            compared: 128,
            search: 2,
        }
    }

    /// For live traffic on two cores; cells are half as large, so the search covers more of them.
    pub fn lean(channels: i64) -> Self {
        Self {
            layers: SwapFusionConfig::lean(channels),
            search: 3,
            ..Self::full(channels)
        }
    }

    /// Checks that a network can be built.
    ///
    /// # Errors
    /// [`ConfigError`] names the field, its value and what it must be.
    pub fn validate(&self) -> Result<(), ConfigError> {
        self.layers.validate()?;
        within("fusion.compared", self.compared, 1, 4096)?;
        within("fusion.search", self.search, 1, 16)?;
        let (field, holds) = ("fusion.layers.count_missing", !self.layers.count_missing);
        let rule = "must be false: only present agents are fused";
        require(holds, field, true, rule)?;
        let is_share = self.kept > 0.0 && self.kept <= 1.0;
        let rule = "must be a share above 0 and up to 1";
        Ok(require(is_share, "fusion.kept", self.kept, rule)?)
    }
}

impl FusionSettings for ErmvpConfig {
    const KIND: &'static str = "ermvp";

    fn for_detector(detector: &DetectorConfig) -> Self {
        of_size(detector, Self::lean, Self::full)
    }

    fn build(&self, path: &nn::Path<'_>) -> Result<Box<dyn Fusion>, ConfigError> {
        Ok(Box::new(Ermvp::new(path, self)?))
    }
}

/// The method behind the common interface.
#[derive(Debug)]
pub struct Ermvp {
    sampler: Sampler,
    consensus: FeatureConsensus,
    /// Attention with queries of the window, then with queries of the whole map.
    layers: Vec<(HalfBlock, GlobalHalf)>,
    head: MeanHead,
    window: i64,
}

impl Ermvp {
    /// Variables below `path`.
    ///
    /// # Errors
    /// [`ConfigError`] when no network can be built from `config`.
    pub fn new(path: &nn::Path<'_>, config: &ErmvpConfig) -> Result<Self, ConfigError> {
        config.validate()?;
        let sizes = &config.layers;
        let (channels, cells, reach) = (sizes.channels, config.compared, config.search);
        Ok(Self {
            sampler: Sampler::new(&(path / "sampler"), channels, config.kept),
            consensus: FeatureConsensus::new(&(path / "consensus"), channels, cells, reach),
            layers: (0..sizes.depth)
                .map(|index| {
                    let path = path / "layers" / index;
                    let (attention, feed) = (&path / "window_attention", &path / "window_ffd");
                    let local = HalfBlock::new(Partition::Window, &attention, &feed, sizes);
                    (local, GlobalHalf::new(&path, sizes))
                })
                .collect(),
            head: MeanHead::new(&(path / "mlp_head"), channels),
            window: sizes.window,
        })
    }

    /// Input of the fusion: maps `[N, H, W, C]` of the selected cells, corrected, and their mask, `[N, H, W]`.
    fn received(&self, maps: &Tensor, reach: &Tensor) -> Result<(Tensor, Tensor), TchError> {
        let agents = maps.size()[0];
        let scores = self.sampler.scores(maps)?;
        let kept = self.sampler.kept(&scores, reach)?;
        let ego = maps.f_get(0)?;
        let mut received = vec![ego.shallow_clone()];
        let mut there = vec![kept.f_get(0)?];
        let ego_score = scores.f_get(0)?;
        for agent in 1..agents {
            let kept = kept.f_get(agent)?;
            let score = scores.f_get(agent)? * &kept;
            // Times the score, which gives the sampler a gradient: the choice of the cells has none.
            let sent = maps.f_get(agent)? * score.f_unsqueeze(2)?;
            let (sent, kept) = match self.consensus.motion(&ego, &sent, &(&ego_score * &score))? {
                Some(motion) => motion.apply(&sent, &kept)?,
                None => (sent, kept),
            };
            received.push(sent);
            there.push(kept);
        }
        Ok((Tensor::f_stack(&received, 0)?, Tensor::f_stack(&there, 0)?))
    }
}

impl Fusion for Ermvp {
    fn fuse(&self, aligned: &AlignedMaps) -> Result<FusionOutput, TchError> {
        let is_training = aligned.is_training;
        let WarpedMaps { features, mask } = nearest_first(aligned)?;
        // Global queries come from a map reduced by REDUCTION, which needs whole windows too.
        let padding = Padding::to_multiples(&features, self.window * REDUCTION)?;
        let maps = padding.maps(&features, 0)?.f_permute([0, 2, 3, 1])?;
        let maps = maps.f_contiguous()?;
        let (mut x, reach) = self.received(&maps, &padding.mask(&mask, 0)?.f_squeeze_dim(1)?)?;
        let slots = Slots {
            asked: reach.size()[0],
            reach: Some(&reach),
            count_missing: false,
        };
        for (local, global) in &self.layers {
            let groups = local.whole(&x, slots, self.window, is_training)?;
            x = Partition::Window.map(&groups, padding.size(), self.window)?;
            x = global.forward(&x, slots, is_training)?;
        }
        Ok(padding.crop(&self.head.forward(&x, slots)?)?.into())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn invalid_settings_are_named() {
        assert!(ErmvpConfig::full(256).validate().is_ok());
        assert!(ErmvpConfig::lean(64).validate().is_ok());
        let none_kept = ErmvpConfig {
            kept: 0.0,
            ..ErmvpConfig::lean(64)
        };
        let far_search = ErmvpConfig {
            search: 99,
            ..ErmvpConfig::lean(64)
        };
        for (config, part) in [
            (none_kept, "fusion.kept is 0"),
            (far_search, "fusion.search"),
        ] {
            let message = config.validate().unwrap_err().to_string();
            assert!(message.contains(part), "{message}");
        }
    }
}
