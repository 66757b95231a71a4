//! Error of quantising a network.

use tch::TchError;

use crate::torch_error::first_line;

/// Error of quantising a network.
#[derive(Debug, thiserror::Error)]
pub enum QuantiseError {
    /// The weights file lacks the scale of an activation.
    #[error("no scale of activation {name:?}; there are those of {known:?}")]
    Scale {
        /// Name of the activation.
        name: String,
        /// Names of those that are there.
        known: Vec<String>,
    },
    /// The tensor library failed.
    #[error("tensor library: {}", first_line(.0))]
    Tensor(#[from] TchError),
}
