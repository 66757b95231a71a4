//! Pose that a network regresses directly.

use nalgebra::{Isometry3, Translation3, UnitQuaternion, Vector3};
use protocol::config::{FieldError, require};
use protocol::{NoPoseReason, PoseEstimate};
use support::stage_times::StageTimes;

use crate::pgc::Localization;

/// The pose with full confidence, since such a network predicts no error; none if it is not finite or has no heading.
pub(super) fn localization(pose: Option<Isometry3<f64>>, times: StageTimes) -> Localization {
    match pose {
        Some(pose) => Localization::from_estimate(PoseEstimate::new(pose.into(), 1.0), times),
        None => no_pose(NoPoseReason::Failed, times),
    }
}

pub(super) fn no_pose(reason: NoPoseReason, times: StageTimes) -> Localization {
    Localization::from_estimate(
        PoseEstimate::NoPose {
            reason,
            inlier_count: 0,
        },
        times,
    )
}

/// Position relative to the origin, cosine and sine of the heading; `None` if that is no pose.
pub(super) fn upright(answer: &[f32], origin_m: [f64; 3]) -> Option<Isometry3<f64>> {
    let &[x, y, z, cosine, sine] = answer else {
        return None;
    };
    let [x, y, z, cosine, sine] = [x, y, z, cosine, sine].map(f64::from);
    // Cosine and sine have length 1, unless the network gives no heading.
    let is_pose = [x, y, z].iter().all(|axis| axis.is_finite()) && cosine.hypot(sine) > 0.5;
    is_pose.then(|| {
        let position = Vector3::new(x, y, z) + Vector3::from(origin_m);
        let heading = UnitQuaternion::from_axis_angle(&Vector3::z_axis(), sine.atan2(cosine));
        Isometry3::from_parts(Translation3::from(position), heading)
    })
}

/// Refuses positions without a finite origin or a scale above 0.
pub(super) fn require_scale(origin_m: [f64; 3], scale_m: [f64; 3]) -> Result<(), FieldError> {
    let is_place = origin_m.iter().all(|axis| axis.is_finite());
    require(is_place, "origin_m", origin_m, "must be finite")?;
    let is_scale = scale_m.iter().all(|axis| axis.is_finite() && *axis > 0.0);
    require(is_scale, "scale_m", scale_m, "must be above 0")
}
