//! Methods without fusion of feature maps: ego-only, late (boxes) and early (points).

use tch::TchError;

use super::interface::{Fusion, FusionOutput};
use super::maps::AlignedMaps;
use super::settings::without_settings;
use super::spec::{Exchange, FusionSpec, MethodSpec};

/// Ego-only, no collaboration: the baseline of every method.
pub static NONE: MethodSpec = MethodSpec {
    name: "none",
    summary: "ego-only, no collaboration",
    exchange: Exchange::Nothing,
    gate: None,
    runs_with_weights_of: &[],
    fusion: FusionSpec::of::<OwnConfig>(),
};

/// Late fusion: boxes are exchanged and merged by NMS.
pub static LATE: MethodSpec = MethodSpec {
    name: "late",
    summary: "boxes, merged by rotated NMS",
    exchange: Exchange::Boxes,
    gate: None,
    runs_with_weights_of: &["none"],
    fusion: FusionSpec::of::<OwnConfig>(),
};

/// Early fusion: points are exchanged and encoded together in the ego frame.
pub static EARLY: MethodSpec = MethodSpec {
    name: "early",
    summary: "points, encoded together in the ego frame",
    exchange: Exchange::Points,
    gate: None,
    runs_with_weights_of: &["early", "none"],
    fusion: FusionSpec::of::<OwnConfig>(),
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
