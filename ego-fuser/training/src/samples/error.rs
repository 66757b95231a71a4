//! Errors of training samples.

use dataset::ReadError;
use localization::pose_source::PoseSourceError;
use tch::TchError;

use crate::feature_store::FeatureStoreError;
use fusion::targets::AnchorGridError;

/// Reason why there is no next sample.
#[derive(Debug, thiserror::Error)]
pub enum SampleError {
    /// A file of a dataset is missing or malformed.
    #[error(transparent)]
    Read(#[from] ReadError),
    /// The evaluation protocol is not known or contradicts itself.
    #[error("evaluation protocol: {0}")]
    Protocol(String),
    /// A dataset has no ticks.
    #[error("{0}")]
    Empty(String),
    /// A frame has no pose, so views cannot be aligned.
    #[error("scenario {scenario}, {capture_nanos} ns: agent {cav} has no pose")]
    NoPose {
        /// The scenario.
        scenario: String,
        /// The capture time.
        capture_nanos: u64,
        /// The agent.
        cav: String,
    },
    /// The settings of the pose error are invalid.
    #[error(transparent)]
    Poses(#[from] PoseSourceError),
    /// Stored maps of a frozen encoder cannot be read.
    #[error(transparent)]
    Maps(#[from] FeatureStoreError),
    /// The tensor library reported an error.
    #[error("samples: {0}")]
    Torch(#[from] TchError),
    /// The anchors of the configuration are not on a grid.
    #[error(transparent)]
    AnchorGrid(#[from] AnchorGridError),
}
