//! Errors of a detector.

use tch::TchError;

use crate::boxes::decode::DecodeError;
use crate::model_config::ConfigError;
use crate::torch_error::first_line;
use crate::weights::WeightsError;

/// Error of loading a detector or of running it.
#[derive(Debug, thiserror::Error)]
pub enum DetectorError {
    /// The weights are not readable or made for another model.
    #[error(transparent)]
    Weights(#[from] WeightsError),
    /// The configuration does not describe a network.
    #[error(transparent)]
    Config(#[from] ConfigError),
    /// A feature map does not have the shape of this detector's.
    #[error("{what} is {found:?}, this detector's is {expected:?} (channels, height, width)")]
    Shape {
        /// Name of the feature map.
        what: &'static str,
        /// Its shape.
        found: Vec<i64>,
        /// The shape of this detector's.
        expected: [i64; 3],
    },
    /// The output of the head does not fit the anchors.
    #[error(transparent)]
    Decode(#[from] DecodeError),
    /// The tensor library failed.
    #[error("tensor library: {}", first_line(.0))]
    Tensor(#[from] TchError),
}
