//! CoAlign (Lu et al., ICRA 2023): pose correction by common boxes, then per-cell fusion.
//!
//! The correction happens before feature maps are warped, see [`crate::pose_graph`]; the fusion itself is attention or
//! the maximum. The published network has a residual backbone and fuses at each of its levels; that is `multi_scale`,
//! for imported weights. Live, an agent sends one feature map, and it is fused once.

use perception::model_config::{ConfigError, DetectorConfig};
use serde::{Deserialize, Serialize};
use tch::nn;

use super::where2comm::{MapAggregation, Missing, Where2comm, Where2commConfig};
use crate::pose_graph::PoseGraphConfig;
use crate::{Fusion, FusionSettings, MethodSpec, Requirements};

/// CoAlign.
pub static METHOD: MethodSpec = MethodSpec::of_features::<CoAlignConfig>(
    "feature maps, poses corrected by the boxes in common, attention (CoAlign)",
);

/// Settings of CoAlign.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub(crate) struct CoAlignConfig {
    /// Operation that fuses the features of a cell.
    pub aggregation: MapAggregation,
    /// Value of cells that were not received.
    pub missing: Missing,
    /// Correction of the poses; absent: poses are used as received.
    pub pose_graph: Option<PoseGraphConfig>,
}

impl Default for CoAlignConfig {
    /// Attention after the correction.
    fn default() -> Self {
        Self {
            aggregation: MapAggregation::Attention,
            missing: Missing::Absent,
            pose_graph: Some(PoseGraphConfig::default()),
        }
    }
}

impl FusionSettings for CoAlignConfig {
    const KIND: &'static str = "coalign";

    fn for_detector(_detector: &DetectorConfig) -> Self {
        Self::default()
    }

    fn build(&self, _path: &nn::Path<'_>) -> Result<Box<dyn Fusion>, ConfigError> {
        Ok(Box::new(Where2comm(Where2commConfig {
            aggregation: self.aggregation,
            missing: self.missing,
        })))
    }

    fn requirements(&self) -> Requirements {
        Requirements {
            pose_graph: self.pose_graph,
            ..Requirements::default()
        }
    }
}
