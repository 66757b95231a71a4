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
    /// The detector whose encoder is used failed.
    #[error(transparent)]
    Detector(#[from] DetectorError),
    /// The tensor library failed.
    #[error("tensor library: {}", first_line(.0))]
    Tensor(#[from] TchError),
}
