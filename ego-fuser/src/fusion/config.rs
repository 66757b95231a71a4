//! Which fusion a network has, and of what size.

use agent::model_config::{ConfigError, DetectorConfig};
use serde::{Deserialize, Serialize};
use tch::nn;

use super::cobevt::{Cobevt, CobevtConfig};
use super::v2xvit::{V2xVit, V2xVitConfig};
use super::pastat::{Pastat, PastatConfig};
use super::{AttentionFusion, Fusion, MaxFusion, NoFusion};
use crate::Method;

/// Metadata key of the fusion's configuration in a weights file.
pub const FUSION_KEY: &str = "fusion";

/// Maps with more channels are fused by modules of full size.
const LEAN_CHANNELS: i64 = 128;

/// What the fusion of a network is built from, stored as JSON beside its weights.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(tag = "kind", rename_all = "snake_case", deny_unknown_fields)]
pub enum FusionConfig {
    /// The ego's own map.
    Own,
    /// Element-wise maximum.
    Max,
    /// Attention without parameters.
    Attention,
    /// V2X-ViT.
    #[serde(rename = "v2xvit")]
    V2xVit(V2xVitConfig),
    /// CoBEVT.
    Cobevt(CobevtConfig),
    /// PASTAT.
    Pastat(PastatConfig),
}

impl FusionConfig {
    /// The fusion that a method has behind `detector`; methods that exchange no feature maps fuse none.
    #[must_use]
    pub fn for_detector(method: Method, detector: &DetectorConfig) -> Self {
        let channels = detector.feature_channels();
        let is_lean = channels <= LEAN_CHANNELS;
        match method {
            Method::None | Method::Late | Method::Early => Self::Own,
            Method::Max => Self::Max,
            Method::Attention => Self::Attention,
            Method::V2xVit if is_lean => Self::V2xVit(V2xVitConfig::lean(channels)),
            Method::V2xVit => Self::V2xVit(V2xVitConfig::full(channels)),
            Method::Cobevt if is_lean => Self::Cobevt(CobevtConfig::lean(channels)),
            Method::Cobevt => Self::Cobevt(CobevtConfig::full(channels)),
            Method::Pastat if is_lean => Self::Pastat(PastatConfig::lean(channels)),
            Method::Pastat => Self::Pastat(PastatConfig::full(channels)),
        }
    }

    /// Builds the fusion with its variables below `path`.
    ///
    /// # Errors
    /// [`ConfigError`] names the field that no fusion can be built from.
    pub fn build(&self, path: &nn::Path<'_>) -> Result<Box<dyn Fusion>, ConfigError> {
        Ok(match self {
            Self::Own => Box::new(NoFusion),
            Self::Max => Box::new(MaxFusion),
            Self::Attention => Box::new(AttentionFusion),
            Self::V2xVit(config) => Box::new(V2xVit::new(path, config)?),
            Self::Cobevt(config) => Box::new(Cobevt::new(path, config)?),
            Self::Pastat(config) => Box::new(Pastat::new(path, config)?),
        })
    }
}
