//! Errors of a localizer.

use protocol::config::FieldError;
use tch::TchError;

use perception::detector::DetectorError;
use perception::torch_error::first_line;
use perception::weights::FileError;

/// Result of loading a localizer or of localizing: a [`LocalizerError`] if nothing else is named.
pub(crate) type Result<T, E = LocalizerError> = std::result::Result<T, E>;

/// Error of loading a localizer or of localizing a sweep.
#[derive(Debug, thiserror::Error)]
pub enum LocalizerError {
    /// The weights are not readable or made for another model.
    #[error(transparent)]
    Weights(#[from] FileError),
    /// A setting does not describe a network.
    #[error("localizer: {0}")]
    Setting(#[from] FieldError),
    /// The parts of a localizer do not fit together.
    #[error("localizer: {0}")]
    Config(String),
    /// Fitted numbers in a head's file are not valid.
    #[error("{head}: {key}: {reason}")]
    Fitted {
        /// Path of the head.
        head: String,
        /// Their key in the file's metadata.
        key: &'static str,
        /// Field and value that are wrong.
        reason: FieldError,
    },
    /// The head was trained on the features of another encoder.
    #[error("{head}: trained on encoder {expected}, but {encoder} is {found} (SHA-256)")]
    OtherEncoder {
        /// Path of the head.
        head: String,
        /// SHA-256 of the encoder that the head was trained with.
        expected: String,
        /// Path of the encoder.
        encoder: String,
        /// SHA-256 of this encoder.
        found: String,
    },
    /// The detector whose encoder is used failed.
    #[error(transparent)]
    Detector(Box<DetectorError>),
    /// The tensor library failed.
    #[error("tensor library: {}", first_line(.0))]
    Tensor(#[from] TchError),
}

impl From<DetectorError> for LocalizerError {
    fn from(error: DetectorError) -> Self {
        Self::Detector(Box::new(error))
    }
}
