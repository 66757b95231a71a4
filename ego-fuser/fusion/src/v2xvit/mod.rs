//! V2X-ViT: attention across agents at every cell and within windows of several sizes, in turn.
//!
//! Xu et al., ECCV 2022. The mathematics and the names of the parameters are those of the reference, so that its
//! weights fit. Its spatial-temporal correction is the warp that all methods share here: maps are aligned for the time
//! of the ego's newest map. The delay is encoded by the true age rather than by the number of a step.

mod agent_attention;
mod config;
mod encoder;
mod temporal_encoding;
mod window_attention;

use perception::model_config::{ConfigError, DetectorConfig};
use tch::{TchError, Tensor, nn};

pub use agent_attention::AgentAttention;
pub use config::{Merge, V2xVitConfig, WindowConfig};
pub use encoder::{Block, Encoder, Layer};
pub(crate) use temporal_encoding::ROW_SECS;
pub use temporal_encoding::TemporalEncoding;
pub use window_attention::{WindowAttention, WindowBranch};

use super::block_order::BlockOrder;
use super::layers::unseen;
use super::padding::Padding;
use super::settings::of_size;
use crate::{AlignedMaps, Fusion, FusionOutput, FusionSettings, MethodSpec};

/// V2X-ViT.
pub static METHOD: MethodSpec = MethodSpec::of_features::<V2xVitConfig>(
    "feature maps, attention over agents and windows of several sizes (V2X-ViT)",
);

/// All agents are vehicles; the second type of the reference is infrastructure.
const VEHICLE: usize = 0;

impl FusionSettings for V2xVitConfig {
    const KIND: &'static str = "v2xvit";

    fn for_detector(detector: &DetectorConfig) -> Self {
        of_size(detector, Self::lean, Self::full)
    }

    fn build(&self, path: &nn::Path<'_>) -> Result<Box<dyn Fusion>, ConfigError> {
        Ok(Box::new(V2xVit::new(path, self)?))
    }
}

/// The method behind the common interface.
#[derive(Debug)]
pub struct V2xVit {
    encoder: Encoder,
    order: BlockOrder,
}

impl V2xVit {
    /// Variables below `path`, in `encoder`.
    ///
    /// # Errors
    /// [`ConfigError`] when no encoder can be built from `config`.
    pub fn new(path: &nn::Path<'_>, config: &V2xVitConfig) -> Result<Self, ConfigError> {
        config.validate()?;
        let order = config.order()?;
        Ok(Self {
            encoder: Encoder::new(&(path / "encoder"), config, &order),
            order,
        })
    }

    /// The features with the code of each map's age where the map reaches.
    fn with_age(&self, maps: &AlignedMaps) -> Result<Tensor, TchError> {
        let warped = &maps.warped;
        let Some(temporal) = &self.encoder.temporal else {
            return Ok(warped.features.shallow_clone());
        };
        let rows = maps.metadata.iter().map(|map| map.age_secs / ROW_SECS);
        let code = temporal.encode(&rows.collect::<Vec<f64>>())?;
        let code = code.f_unsqueeze(-1)?.f_unsqueeze(-1)?;
        // The reference adds it before the warp, which leaves zeros where a map does not reach.
        warped.features.f_addcmul(&code, &warped.mask)
    }
}

impl Fusion for V2xVit {
    fn fuse(&self, maps: &AlignedMaps) -> Result<FusionOutput, TchError> {
        let mask = &maps.warped.mask;
        let padding = Padding::to_multiples(&maps.warped.features, self.order.largest())?;
        let order = &self.order;
        let tokens = order.tokens(&padding.maps(&self.with_age(maps)?, 0)?)?;
        let sees_all = mask.f_min()?.f_double_value(&[])? > 0.0;
        let unseen = match sees_all && padding.is_empty() {
            true => None,
            false => Some(unseen(&padding.mask(mask, 0)?)?),
        };
        let unseen = unseen.map(|unseen| order.tokens(&unseen)?.f_squeeze_dim(2));
        let unseen = unseen.transpose()?;
        let types = vec![VEHICLE; maps.metadata.len()];
        let fused = self
            .encoder
            .forward(&tokens, unseen.as_ref(), &types, maps.is_training)?;
        let [height, width] = padding.size();
        let fused = order.maps(&fused.f_unsqueeze(0)?, height, width)?;
        Ok(padding.crop(&fused.f_get(0)?)?.into())
    }
}
