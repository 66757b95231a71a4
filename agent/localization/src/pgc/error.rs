//! What can go wrong in a localizer.

use tch::TchError;

use perception::torch_error::first_line;
use perception::weights::WeightsError;

/// Why a localizer cannot be made or a sweep not be localised by it.
#[derive(Debug, thiserror::Error)]
pub enum LocalizerError {
    /// The weights are not readable or made for something else.
    #[error(transparent)]
    Weights(#[from] WeightsError),
    /// The configuration is not one of a network.
    #[error("localizer: {0}")]
    Config(String),
    /// The confidence in a head's file is none that can be computed with.
    #[error("{head}: confidence: {reason}")]
    Confidence {
        /// File of the head.
        head: String,
        /// What is wrong with it.
        reason: String,
    },
    /// The head was trained on the features of another encoder.
    #[error("{head}: trained on encoder {expected}, but {encoder} is {found} (SHA-256)")]
    OtherEncoder {
        /// File of the head.
        head: String,
        /// Hash of the encoder that the head was trained with.
        expected: String,
        /// File of the encoder.
        encoder: String,
        /// Its hash.
        found: String,
    },
    /// The tensor library refused.
    #[error("tensor library: {}", first_line(.0))]
    Tensor(#[from] TchError),
}
