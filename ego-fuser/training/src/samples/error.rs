//! Errors of training samples.

use dataset::ReadError;
use localization::pose_source::PoseSourceError;
use tch::TchError;

use crate::feature_store::FeatureStoreError;
use fusion::targets::LatticeError;

/// Why there is no next sample.
#[derive(Debug, thiserror::Error)]
pub enum SampleError {
    /// A file of a dataset is missing or malformed.
    #[error(transparent)]
    Read(#[from] ReadError),
    /// The evaluation protocol is not known or contradicts itself.
    #[error("evaluation protocol: {0}")]
    Protocol(String),
    /// A dataset has nothing to learn from.
    #[error("{0}")]
    Empty(String),
    /// Nothing is said of a frame's pose, so views cannot be put together.
    #[error("scenario {scenario}, {capture_nanos} ns: nothing is known of the pose of agent {cav}")]
    NoPose {
        /// The scenario.
        scenario: String,
        /// The capture time.
        capture_nanos: u64,
        /// The agent.
        cav: String,
    },
    /// The poses' error makes no sense.
    #[error(transparent)]
    Poses(#[from] PoseSourceError),
    /// Maps of a frozen encoder cannot be had.
    #[error(transparent)]
    Maps(#[from] FeatureStoreError),
    /// The tensor library refused.
    #[error("samples: {0}")]
    Torch(#[from] TchError),
    /// The anchors of the configuration are no lattice.
    #[error(transparent)]
    Lattice(#[from] LatticeError),
}
