//! Methods without fusion of feature maps: ego-only, late (boxes) and early (points).

use tch::TchError;

use super::settings::without_settings;
use crate::{AlignedMaps, Exchange, Fusion, FusionOutput, MethodSpec};

/// Ego-only, no collaboration: the baseline of every method.
pub static NONE: MethodSpec = MethodSpec {
    name: "none",
    exchange: Exchange::Nothing,
    ..MethodSpec::of_features::<OwnConfig>("ego-only, no collaboration")
};

/// Late fusion: boxes are exchanged and merged by NMS.
pub static LATE: MethodSpec = MethodSpec {
    name: "late",
    exchange: Exchange::Boxes,
    runs_with_weights_of: &["none"],
    ..MethodSpec::of_features::<OwnConfig>("boxes, merged by rotated NMS")
};

/// Early fusion: points are exchanged and encoded together in the ego frame.
pub static EARLY: MethodSpec = MethodSpec {
    name: "early",
    exchange: Exchange::Points,
    runs_with_weights_of: &["early", "none"],
    ..MethodSpec::of_features::<OwnConfig>("points, encoded together in the ego frame")
};

without_settings!(OwnConfig, "own", NoFusion);

/// The ego's own feature map, whatever the others send.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct NoFusion;

impl Fusion for NoFusion {
    fn fuse(&self, maps: &AlignedMaps) -> Result<FusionOutput, TchError> {
        Ok(maps.warped.features.f_get(0)?.into())
    }
}
