//! Why an evaluation ended early.

use dataset::ReadError;
use link::LinkError;
use localization::pose_source::PoseSourceError;
use perception::detector::DetectorError;
use perception::weights::WeightsError;
use protocol::WireError;

use super::stepped::RemoteError;
use ego_fuser::ego::EgoError;
use training::feature_store::FeatureStoreError;

/// Why an evaluation ended early.
#[derive(Debug, thiserror::Error)]
pub enum EvaluateError {
    /// The weights are not readable.
    #[error(transparent)]
    Weights(#[from] WeightsError),
    /// The detector refused.
    #[error(transparent)]
    Detector(#[from] DetectorError),
    /// The ego refused.
    #[error(transparent)]
    Ego(#[from] EgoError),
    /// A pose source cannot be set up.
    #[error(transparent)]
    PoseSource(#[from] PoseSourceError),
    /// A frame cannot be read.
    #[error(transparent)]
    Read(#[from] ReadError),
    /// A message cannot be encoded or decoded.
    #[error(transparent)]
    Wire(#[from] WireError),
    /// Kept maps cannot be read.
    #[error(transparent)]
    Maps(#[from] Box<FeatureStoreError>),
    /// The emulated air cannot be made.
    #[error(transparent)]
    Link(#[from] LinkError),
    /// Vehicles in processes of their own do not answer.
    #[error(transparent)]
    Remote(#[from] Box<RemoteError>),
    /// A computer of the fleet does not keep up with the scene.
    #[error(
        "{what} takes {takes_ms} ms, but the scene has a frame every {period_ms} ms: choose a smaller time in `compute`"
    )]
    TooSlow {
        /// What takes too long.
        what: &'static str,
        /// How long, milliseconds.
        takes_ms: f64,
        /// From frame to frame, milliseconds.
        period_ms: f64,
    },
}
