//! Errors of an evaluation.

use dataset::ReadError;
use link::LinkError;
use localization::pose_source::PoseSourceError;
use perception::detector::DetectorError;
use perception::weights::FileError;
use protocol::WireError;
use protocol::config::FieldError;

use super::stepped::RemoteError;
use ego_fuser::ego::EgoError;

/// Reason why an evaluation ended early.
#[derive(Debug, thiserror::Error)]
pub enum EvaluateError {
    /// The weights are not readable.
    #[error(transparent)]
    Weights(#[from] FileError),
    /// A setting of a vehicle does not suit its network.
    #[error(transparent)]
    Setting(#[from] FieldError),
    /// The detector reported an error.
    #[error(transparent)]
    Detector(#[from] DetectorError),
    /// The ego reported an error.
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
    Maps(#[from] Box<training::Error>),
    /// The link emulation cannot be built.
    #[error(transparent)]
    Link(#[from] LinkError),
    /// Vehicles in processes of their own do not answer.
    #[error(transparent)]
    Remote(#[from] Box<RemoteError>),
    /// The compute time of a process exceeds the period of the scene: the process or step that takes too long, and both
    /// times.
    #[error(
        "{0}: set a smaller time in `compute` (without one the times are measured on this machine)"
    )]
    TooSlow(String),
}
