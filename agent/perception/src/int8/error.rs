//! Error of quantising a network.

use tch::TchError;

use super::activation_scales::MissingScale;
use crate::torch_error::first_line;

/// Error of quantising a network.
#[derive(Debug, thiserror::Error)]
pub enum QuantiseError {
    /// The weights file lacks the scale of an activation.
    #[error(transparent)]
    Scale(#[from] MissingScale),
    /// The tensor library failed.
    #[error("tensor library: {}", first_line(.0))]
    Tensor(#[from] TchError),
}
