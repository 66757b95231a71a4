//! Error of quantising a network.

use tch::TchError;

use crate::torch_error::first_line;

/// Error of quantising a network.
#[derive(Debug, thiserror::Error)]
pub enum QuantiseError {
    /// The weights file lacks the scale of an activation: its name, and the names of those that are there.
    #[error("no scale of activation {0:?}; there are those of {1:?}")]
    Scale(String, Vec<String>),
    /// The tensor library failed.
    #[error("tensor library: {}", first_line(.0))]
    Tensor(#[from] TchError),
}
