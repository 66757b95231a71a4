//! What can go wrong in a detector.

use tch::TchError;

use crate::boxes::decode::DecodeError;
use crate::model_config::ConfigError;
use crate::torch_error::first_line;
use crate::weights::WeightsError;

/// Why a detector cannot be made or a map not be read by it.
#[derive(Debug, thiserror::Error)]
pub enum DetectorError {
    /// The weights are not readable or made for something else.
    #[error(transparent)]
    Weights(#[from] WeightsError),
    /// The configuration is not one of a network.
    #[error(transparent)]
    Config(#[from] ConfigError),
    /// A map has not the shape of this detector's.
    #[error("{what} is {found:?}, this detector's is {expected:?} (channels, height, width)")]
    Shape {
        /// Which map.
        what: &'static str,
        /// Its shape.
        found: Vec<i64>,
        /// The shape of this detector's.
        expected: [i64; 3],
    },
    /// The output of the head does not fit the anchors.
    #[error(transparent)]
    Decode(#[from] DecodeError),
    /// The tensor library refused.
    #[error("tensor library: {}", first_line(.0))]
    Tensor(#[from] TchError),
}
