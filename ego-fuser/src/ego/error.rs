//! Errors of the ego's pipeline.

use perception::detector::DetectorError;
use perception::weights::FileError;
use tch::TchError;

use fusion::method::UnknownMethod;
use fusion::model::StageError;
use fusion::warp::WarpError;

/// Reason why the ego has no result at all. A faulty message of a neighbour never leads here.
#[derive(Debug, thiserror::Error)]
pub enum EgoError {
    /// The weights are not readable.
    #[error(transparent)]
    Weights(#[from] FileError),
    /// The detector reported an error.
    #[error(transparent)]
    Detector(#[from] DetectorError),
    /// The weights name a method that is not known.
    #[error(transparent)]
    Method(#[from] UnknownMethod),
    /// The fusion does not fit the weights.
    #[error(transparent)]
    Fusion(#[from] StageError),
    /// Own maps cannot be aligned.
    #[error(transparent)]
    Warp(#[from] WarpError),
    /// The ego's own view does not have the content that the method needs: the method, and both.
    #[error("method {0}")]
    OwnContent(String),
    /// The ego's own map is of another network: channels and BEV grid found, and those of the network.
    #[error("the ego's own map is {0}")]
    OwnMap(String),
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
