//! Errors of the ego's pipeline.

use perception::detector::DetectorError;
use perception::weights::FileError;
use tch::TchError;

use fusion::method::UnknownMethod;
use fusion::warp::WarpError;

/// Reason why the ego has no result at all. A faulty message of a neighbour never leads here.
#[derive(Debug, thiserror::Error)]
pub enum EgoError {
    /// The weights are not readable, or the fusion does not fit them.
    #[error(transparent)]
    Weights(#[from] FileError),
    /// The detector reported an error.
    #[error(transparent)]
    Detector(#[from] DetectorError),
    /// The weights name a method that is not known.
    #[error(transparent)]
    Method(#[from] UnknownMethod),
    /// Own maps cannot be aligned.
    #[error(transparent)]
    Warp(#[from] WarpError),
    /// The ego's own view does not have the content that the method needs, or its map is of another network: both.
    #[error("{0}")]
    OwnView(String),
    /// The tensor library reported an error.
    #[error("fusion: {0}")]
    Torch(#[from] TchError),
}

impl EgoError {
    /// True if one frame cannot be computed, and others may be, see [`DetectorError::is_of_frame`].
    pub fn is_of_frame(&self) -> bool {
        matches!(self, Self::Detector(error) if error.is_of_frame())
    }
}
