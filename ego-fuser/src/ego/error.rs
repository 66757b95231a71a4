//! Why the ego has no result.

use perception::detector::DetectorError;
use perception::weights::WeightsError;
use protocol::BevGrid;
use tch::TchError;

use fusion::method::{Exchange, Method, UnknownMethod};
use fusion::model::StageError;
use fusion::warp::WarpError;

/// Why the ego has no result at all. What is wrong with a neighbour never leads here.
#[derive(Debug, thiserror::Error)]
pub enum EgoError {
    /// The weights are not readable.
    #[error(transparent)]
    Weights(#[from] WeightsError),
    /// The detector refused.
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
    /// The ego's own view is not what the method takes.
    #[error("method {method} needs the ego's own {needed:?}, not {found:?}")]
    OwnContent {
        /// The method.
        method: Method,
        /// What it needs.
        needed: Exchange,
        /// What came.
        found: Exchange,
    },
    /// The ego's own map is of another network.
    #[error("the ego's own map is {channels} x {found}, the network's is {expected_channels} x {expected}")]
    OwnMap {
        /// Channels found.
        channels: u32,
        /// Lattice found.
        found: BevGrid,
        /// Channels of the network.
        expected_channels: i64,
        /// Lattice of the network.
        expected: BevGrid,
    },
    /// The tensor library refused.
    #[error("fusion: {0}")]
    Torch(#[from] TchError),
}
