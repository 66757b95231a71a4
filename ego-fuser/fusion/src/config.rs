//! Which fusion a network has, and of what size.

use std::ops::RangeInclusive;

use perception::model_config::{ConfigError, DetectorConfig};
use serde::{Deserialize, Serialize};
use tch::nn;

use super::coalign::CoAlignConfig;
use super::cobevt::{Cobevt, CobevtConfig};
use super::disconet::{DiscoNet, DiscoNetConfig};
use super::ermvp::{Ermvp, ErmvpConfig};
use super::pastat::{Part, Pastat, PastatConfig};
use super::traf_align::{TrafAlign, TrafAlignConfig};
use super::v2vnet::{V2vNet, V2vNetConfig};
use super::v2xvit::{V2xVit, V2xVitConfig};
use super::where2comm::{Where2comm, Where2commConfig};
use super::{AttentionFusion, Fusion, MaxFusion, NoFusion};
use crate::Method;
use crate::pose_graph::PoseGraphConfig;

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
    /// Attention or maximum over the cells worth sending.
    Where2comm(Where2commConfig),
    /// Attention or maximum after a correction of the poses.
    #[serde(rename = "coalign")]
    CoAlign(CoAlignConfig),
    /// Messages between vehicles.
    #[serde(rename = "v2vnet")]
    V2vNet(V2vNetConfig),
    /// A weight per agent and cell.
    #[serde(rename = "disconet")]
    DiscoNet(DiscoNetConfig),
    /// V2X-ViT.
    #[serde(rename = "v2xvit")]
    V2xVit(V2xVitConfig),
    /// CoBEVT.
    Cobevt(CobevtConfig),
    /// ERMVP.
    Ermvp(ErmvpConfig),
    /// Attention along trajectories.
    TrafAlign(TrafAlignConfig),
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
            Method::Where2comm => Self::Where2comm(Where2commConfig::default()),
            Method::CoAlign => Self::CoAlign(CoAlignConfig::default()),
            Method::V2vNet if is_lean => Self::V2vNet(V2vNetConfig::lean(channels)),
            Method::V2vNet => Self::V2vNet(V2vNetConfig::full(channels)),
            Method::DiscoNet if is_lean => Self::DiscoNet(DiscoNetConfig::lean(channels)),
            Method::DiscoNet => Self::DiscoNet(DiscoNetConfig::full(channels)),
            Method::V2xVit if is_lean => Self::V2xVit(V2xVitConfig::lean(channels)),
            Method::V2xVit => Self::V2xVit(V2xVitConfig::full(channels)),
            Method::Cobevt if is_lean => Self::Cobevt(CobevtConfig::lean(channels)),
            Method::Cobevt => Self::Cobevt(CobevtConfig::full(channels)),
            Method::Ermvp if is_lean => Self::Ermvp(ErmvpConfig::lean(channels)),
            Method::Ermvp => Self::Ermvp(ErmvpConfig::full(channels)),
            Method::TrafAlign if is_lean => Self::TrafAlign(TrafAlignConfig::lean(channels)),
            Method::TrafAlign => Self::TrafAlign(TrafAlignConfig::full(channels)),
            Method::Pastat if is_lean => Self::Pastat(PastatConfig::lean(channels)),
            Method::Pastat => Self::Pastat(PastatConfig::full(channels)),
        }
    }

    /// How poses are corrected by boxes before maps are moved, for a fusion that asks for it.
    #[must_use]
    pub fn pose_graph(&self) -> Option<&PoseGraphConfig> {
        match self {
            Self::CoAlign(config) => config.pose_graph.as_ref(),
            _ => None,
        }
    }

    /// The same without some parts of PASTAT, or with another number of time steps; other methods have no such parts.
    ///
    /// # Errors
    /// [`ConfigError`] where there is nothing to leave out.
    pub fn ablated(self, without: &[Part], frames: Option<usize>) -> Result<Self, ConfigError> {
        match self {
            Self::Pastat(config) => {
                let frames = frames.unwrap_or(config.frames);
                // One time step has nothing to recall.
                let without = if frames == 1 { [without, &[Part::Recall]].concat() } else { without.to_vec() };
                Ok(Self::Pastat(PastatConfig { frames, ..config.without(&without) }))
            }
            other if without.is_empty() && frames.is_none() => Ok(other),
            _ => {
                let value = format!("without {without:?}, {frames:?} frames");
                Err(ConfigError::Value { field: "fusion", value, must: "as it is but for pastat" })
            }
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
            Self::Where2comm(config) => Box::new(Where2comm::new(config)),
            Self::CoAlign(config) => Box::new(config.fusion()),
            Self::V2vNet(config) => Box::new(V2vNet::new(path, config)?),
            Self::DiscoNet(config) => Box::new(DiscoNet::new(path, config)?),
            Self::V2xVit(config) => Box::new(V2xVit::new(path, config)?),
            Self::Cobevt(config) => Box::new(Cobevt::new(path, config)?),
            Self::Ermvp(config) => Box::new(Ermvp::new(path, config)?),
            Self::TrafAlign(config) => Box::new(TrafAlign::new(path, config)?),
            Self::Pastat(config) => Box::new(Pastat::new(path, config)?),
        })
    }
}

/// Checks a number of a fusion's configuration.
pub(super) fn within(field: &'static str, value: i64, allowed: RangeInclusive<i64>) -> Result<(), ConfigError> {
    if allowed.contains(&value) {
        return Ok(());
    }
    Err(ConfigError::Value { field, value: value.to_string(), must: "positive and of a size that a network can have" })
}
