//! Pose estimate of an agent, or the reason why it has none.

use serde::{Deserialize, Serialize};

use super::{check_pose, check_within, metadata_only};
use crate::{Limits, Pose, WireError};

/// Pose estimate of an agent, or the reason why it has none: agent to ego, on its own as soon as it is known, and again
/// in every message that needs it.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum PoseEstimate {
    /// A pose was found.
    Pose {
        /// Pose of its LiDAR.
        world_from_cav: Pose,
        /// Confidence of the pose (sigma of the method), 0..=1.
        confidence: f32,
        /// Covariance in the plane, for sources that have one: a pose tracker.
        covariance: Option<PlanarCovariance>,
    },
    /// No pose was found.
    NoPose {
        /// Reason for the missing pose.
        reason: NoPoseReason,
        /// Number of inliers, if correspondences were searched.
        inlier_count: u32,
    },
}

/// Covariance of a pose in the plane of the world: position and yaw.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct PlanarCovariance {
    /// Variance of x, square metres.
    pub xx_m2: f32,
    /// Covariance of x and y, square metres.
    pub xy_m2: f32,
    /// Variance of y, square metres.
    pub yy_m2: f32,
    /// Variance of the yaw, square radians.
    pub yaw_rad2: f32,
}

/// Largest variance of a message: a standard deviation of a kilometre.
const MAX_VARIANCE: f64 = 1e6;
/// 95 % quantile of the chi-square distribution with two degrees of freedom.
const CHI_SQUARE_95: f64 = 5.991;

impl PlanarCovariance {
    /// Variance of the position along its worst direction, square metres: the larger eigenvalue.
    pub fn worst_variance_m2(&self) -> f64 {
        let [xx, xy, yy] = [self.xx_m2, self.xy_m2, self.yy_m2].map(f64::from);
        let half_difference = (xx - yy) / 2.0;
        f64::midpoint(xx, yy) + half_difference.hypot(xy)
    }

    /// Radius of the circle that holds the true position with a probability of at least 95 %, metres.
    pub fn bound_95_m(&self) -> f64 {
        (CHI_SQUARE_95 * self.worst_variance_m2()).sqrt()
    }

    fn check_values(&self) -> Result<(), WireError> {
        let [xx, xy, yy] = [self.xx_m2, self.xy_m2, self.yy_m2].map(f64::from);
        let yaw = self.yaw_rad2.into();
        check_within("covariance xx_m2", xx, 0.0, MAX_VARIANCE)?;
        check_within("covariance yy_m2", yy, 0.0, MAX_VARIANCE)?;
        check_within("covariance yaw_rad2", yaw, 0.0, MAX_VARIANCE)?;
        // Rounding to single precision may exceed the bound by a little.
        let bound = (xx * yy).sqrt() * (1.0 + 1e-5);
        check_within("covariance xy_m2", xy, -bound, bound)
    }
}

/// Reason why an agent has no pose.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize, strum::IntoStaticStr)]
#[serde(rename_all = "snake_case")]
#[strum(serialize_all = "snake_case")]
pub enum NoPoseReason {
    /// The sweep has too few points.
    TooFewPoints,
    /// Too few inliers.
    TooFewInliers,
    /// The recording or receiver that poses are taken from has none for this sweep.
    NoSource,
    /// A pose was found, but its confidence is too low.
    LowConfidence,
    /// The localizer failed to compute.
    Failed,
    /// The localizer was trained on few or no sweeps near the last pose of the vehicle.
    LowCoverage,
}

impl PoseEstimate {
    /// No pose, for a reason, from a number of inliers.
    pub const fn no_pose(reason: NoPoseReason, inlier_count: u32) -> Self {
        Self::NoPose {
            reason,
            inlier_count,
        }
    }

    /// A pose and its confidence, without a covariance.
    pub fn new(world_from_cav: Pose, confidence: f32) -> Self {
        Self::Pose {
            world_from_cav,
            confidence,
            covariance: None,
        }
    }

    /// Covariance of the pose in the plane, if its source has one.
    pub fn covariance(&self) -> Option<&PlanarCovariance> {
        match self {
            Self::Pose { covariance, .. } => covariance.as_ref(),
            Self::NoPose { .. } => None,
        }
    }

    /// The pose, if there is one.
    pub fn world_from_cav(&self) -> Option<&Pose> {
        match self {
            Self::Pose { world_from_cav, .. } => Some(world_from_cav),
            Self::NoPose { .. } => None,
        }
    }

    /// Confidence of the pose, 0..=1; 0 without a pose.
    pub fn confidence(&self) -> f32 {
        match self {
            Self::Pose { confidence, .. } => *confidence,
            Self::NoPose { .. } => 0.0,
        }
    }

    pub(super) fn check_values(&self, _: &Limits) -> Result<(), WireError> {
        match self {
            Self::Pose {
                world_from_cav,
                confidence,
                covariance,
            } => {
                check_pose("world_from_cav", world_from_cav)?;
                check_within("confidence", f64::from(*confidence), 0.0, 1.0)?;
                let mut covariance = covariance.iter();
                covariance.try_for_each(PlanarCovariance::check_values)
            }
            Self::NoPose { .. } => Ok(()),
        }
    }
}

metadata_only!(PoseEstimate, Pose);

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_bound_is_that_of_the_worst_direction() {
        // Two metres along the diagonal, half a metre across.
        let (along, across) = (4.0_f32, 0.25_f32);
        let covariance = PlanarCovariance {
            xx_m2: f32::midpoint(along, across),
            xy_m2: (along - across) / 2.0,
            yy_m2: f32::midpoint(along, across),
            yaw_rad2: 0.0,
        };
        assert!((covariance.worst_variance_m2() - 4.0).abs() < 1e-6);
        assert!((covariance.bound_95_m() - 2.0 * 2.4477).abs() < 1e-3);
        covariance.check_values().unwrap();
    }

    #[test]
    fn a_covariance_that_is_none_is_rejected_by_its_field() {
        let good = PlanarCovariance {
            xx_m2: 1.0,
            xy_m2: 0.5,
            yy_m2: 1.0,
            yaw_rad2: 0.1,
        };
        let field =
            |covariance: PlanarCovariance| covariance.check_values().unwrap_err().to_string();
        assert!(
            field(PlanarCovariance {
                xx_m2: -1.0,
                ..good
            })
            .contains("xx_m2")
        );
        assert!(field(PlanarCovariance { xy_m2: 1.1, ..good }).contains("xy_m2"));
        assert!(
            field(PlanarCovariance {
                yy_m2: f32::NAN,
                ..good
            })
            .contains("yy_m2")
        );
        assert!(
            field(PlanarCovariance {
                yaw_rad2: f32::INFINITY,
                ..good
            })
            .contains("yaw_rad2")
        );
    }
}
