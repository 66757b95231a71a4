//! CoBEVT: swap fusion of the agents' feature maps.
//!
//! Xu et al., CoRL 2022, with the LiDAR configuration of OpenCOOD. The reference numbers agents in order of arrival;
//! here neighbours are numbered by their distance from the ego, so that the order of arrival does not matter. Its mean
//! over the slots includes empty ones; networks that are trained here take the mean over the slots that reach a cell,
//! and need not compute the others. `count_missing` restores the published behaviour.

use perception::model_config::{ConfigError, DetectorConfig};
use tch::{TchError, nn};

use super::f64_tensor::picked;
use super::padding::Padding;
use super::settings::of_size;
use super::swap_fusion::{Slots, SwapFusion, SwapFusionConfig};
use super::warp::WarpedMaps;
use crate::{AlignedMaps, Fusion, FusionOutput, FusionSettings, MethodSpec};

/// CoBEVT.
pub static METHOD: MethodSpec = MethodSpec::of_features::<SwapFusionConfig>(
    "feature maps, attention over agents within windows and grids (CoBEVT)",
);

impl FusionSettings for SwapFusionConfig {
    const KIND: &'static str = "cobevt";

    fn for_detector(detector: &DetectorConfig) -> Self {
        of_size(detector, Self::lean, Self::full)
    }

    fn build(&self, path: &nn::Path<'_>) -> Result<Box<dyn Fusion>, ConfigError> {
        Ok(Box::new(Cobevt::new(path, self)?))
    }
}

/// The method behind the common interface.
#[derive(Debug)]
pub struct Cobevt {
    fusion: SwapFusion,
    config: SwapFusionConfig,
}

impl Cobevt {
    /// Variables below `path`.
    ///
    /// # Errors
    /// [`ConfigError`] when no network can be built from `config`.
    pub fn new(path: &nn::Path<'_>, config: &SwapFusionConfig) -> Result<Self, ConfigError> {
        config.validate()?;
        Ok(Self {
            fusion: SwapFusion::new(path, config, true),
            config: config.clone(),
        })
    }
}

impl Fusion for Cobevt {
    fn fuse(&self, maps: &AlignedMaps) -> Result<FusionOutput, TchError> {
        let agents = maps.warped.count()?;
        let (window, count_missing) = (self.config.window, self.config.count_missing);
        let WarpedMaps { features, mask } = nearest_first(maps)?;
        // Where all maps reach every cell, neither the product with the mask nor masked attention is needed.
        let sees_all = mask.f_min()?.f_double_value(&[])? > 0.0;
        let features = if sees_all { features } else { features * &mask };
        // For published weights: empty slots are maps of zeros that count in the mean at the end.
        let missing = (self.config.slots - agents).max(0);
        let empty = if count_missing { missing } else { 0 };
        let padding = Padding::to_multiples(&features, window)?;
        let features = padding.maps(&features, empty)?;
        let is_full = sees_all && empty == 0 && padding.is_empty();
        let reach = (!is_full).then(|| padding.mask(&mask, empty)?.f_squeeze_dim(1));
        let reach = reach.transpose()?;
        let slots = Slots {
            asked: agents,
            reach: reach.as_ref(),
            count_missing,
        };
        let fused = self.fusion.forward(&features, slots, maps.is_training)?;
        Ok(padding.crop(&fused)?.into())
    }
}

/// The warped maps, the ego's first and then by distance.
pub(super) fn nearest_first(maps: &AlignedMaps) -> Result<WarpedMaps, TchError> {
    let mut order: Vec<i64> = (0..maps.metadata.len() as i64).collect();
    order.sort_by(|&one, &other| {
        let [one, other] = [one as usize, other as usize].map(|index| {
            let [x, y, _] = maps.metadata[index].ego_from_cav.translation_m;
            // Below every distance: the ego stays first beside a neighbour at the same place.
            if index == 0 { -1.0 } else { x.hypot(y) }
        });
        one.total_cmp(&other)
    });
    maps.warped.each(|map| picked(map, &order))
}
