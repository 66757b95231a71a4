//! F-Cooper: element-wise maximum over the agents.

use perception::model_config::{ConfigError, DetectorConfig};
use serde::{Deserialize, Serialize};
use tch::{TchError, Tensor, nn};

use super::interface::{Fusion, FusionOutput};
use super::maps::AlignedMaps;
use super::settings::FusionSettings;
use super::spec::{Exchange, FusionSpec, MethodSpec};
use crate::warp::WarpedMaps;

/// F-Cooper.
pub static METHOD: MethodSpec = MethodSpec {
    name: "max",
    summary: "feature maps, element-wise maximum (F-Cooper)",
    exchange: Exchange::Features,
    gate: None,
    runs_with_weights_of: &[],
    fusion: FusionSpec::of::<MaxConfig>(),
};

/// Settings of [`MaxFusion`]: none.
#[derive(Debug, Clone, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct MaxConfig {}

impl FusionSettings for MaxConfig {
    const KIND: &'static str = "max";

    fn for_detector(_detector: &DetectorConfig) -> Self {
        Self {}
    }

    fn build(&self, _path: &nn::Path<'_>) -> Result<Box<dyn Fusion>, ConfigError> {
        Ok(Box::new(MaxFusion))
    }
}

/// Element-wise maximum over the agents that reach a cell.
#[derive(Debug, Clone, Copy, Default)]
pub struct MaxFusion;

impl Fusion for MaxFusion {
    fn fuse(&self, maps: &AlignedMaps) -> Result<FusionOutput, TchError> {
        Ok(maximum(&maps.warped)?.into())
    }
}

/// `[C, H, W]`: the maximum over the maps that reach a cell.
pub(super) fn maximum(WarpedMaps { features, mask }: &WarpedMaps) -> Result<Tensor, TchError> {
    if features.size4()?.0 == 1 {
        return features.f_get(0);
    }
    // Zero is an ordinary value for the maximum, so cells out of reach must be below all values.
    features
        .f_masked_fill(&mask.f_eq(0.0)?, f64::NEG_INFINITY)?
        .f_amax([0i64].as_slice(), false)
}
