//! Pose estimate of an agent, or the reason why it has none.

use serde::{Deserialize, Serialize};

use super::{check_pose, check_within, metadata_only};
use crate::Limits;
use crate::Pose;
use crate::WireError;

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
    },
    /// No pose was found.
    NoPose {
        /// Reason for the missing pose.
        reason: NoPoseReason,
        /// Number of inliers, if correspondences were searched.
        inlier_count: u32,
    },
}

/// Reason why an agent has no pose.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
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
}

impl PoseEstimate {
    /// A pose and its confidence.
    #[must_use]
    pub fn new(world_from_cav: Pose, confidence: f32) -> Self {
        Self::Pose { world_from_cav, confidence }
    }

    /// The pose, if there is one.
    #[must_use]
    pub fn world_from_cav(&self) -> Option<&Pose> {
        match self {
            Self::Pose { world_from_cav, .. } => Some(world_from_cav),
            Self::NoPose { .. } => None,
        }
    }

    /// Confidence of the pose, 0..=1; 0 without a pose.
    #[must_use]
    pub fn confidence(&self) -> f32 {
        match self {
            Self::Pose { confidence, .. } => *confidence,
            Self::NoPose { .. } => 0.0,
        }
    }

    pub(super) fn check_values(&self, _: &Limits) -> Result<(), WireError> {
        match self {
            Self::Pose { world_from_cav, confidence } => {
                check_pose("world_from_cav", world_from_cav)?;
                check_within("confidence", f64::from(*confidence), 0.0, 1.0)
            }
            Self::NoPose { .. } => Ok(()),
        }
    }
}

metadata_only!(PoseEstimate, Pose);
