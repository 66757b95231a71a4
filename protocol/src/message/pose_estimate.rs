//! Where an agent believes to be.

use serde::{Deserialize, Serialize};

use super::{check_pose, check_within, metadata_only};
use crate::Limits;
use crate::Pose;
use crate::WireError;

/// An agent's own pose, or why it has none: agent to ego, alone as soon as it is known and again inside everything
/// that needs it.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum PoseEstimate {
    /// The agent knows where it is.
    Pose {
        /// Pose of its LiDAR.
        world_from_cav: Pose,
        /// How sure it is, sigma of the method, 0..=1.
        confidence: f32,
    },
    /// It does not know, and says so rather than making a pose up.
    NoPose {
        /// Why.
        reason: NoPoseReason,
        /// Correspondences that agreed, where any were sought.
        inlier_count: u32,
    },
}

/// Why an agent has no pose.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum NoPoseReason {
    /// The sweep has too few points to localise with.
    TooFewPoints,
    /// Too few correspondences agree on one pose.
    TooFewInliers,
    /// The recording or receiver that poses are taken from has none for this sweep.
    NoSource,
    /// A pose was found, but too little speaks for it.
    LowConfidence,
    /// The localizer could not compute.
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

    /// How sure the agent is, 0..=1; 0 without a pose.
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
