//! F-Cooper: element-wise maximum over the agents.

use tch::{TchError, Tensor};

use super::settings::without_settings;
use crate::warp::WarpedMaps;
use crate::{AlignedMaps, Fusion, FusionOutput, MethodSpec};

/// F-Cooper.
pub static METHOD: MethodSpec =
    MethodSpec::of_features::<MaxConfig>("feature maps, element-wise maximum (F-Cooper)");

without_settings!(MaxConfig, "max", MaxFusion);

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
