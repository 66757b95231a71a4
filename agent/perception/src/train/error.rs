//! Errors that end any training early.

use support::cli::Interrupted;
use support::file_error::FileError;
use tch::TchError;

use crate::torch_error::first_line;

/// Error that ends a training early.
#[derive(Debug, thiserror::Error)]
pub enum TrainingError {
    /// Ended on request after so many steps; the checkpoint is written.
    #[error("stopped at step {0}; --resume goes on")]
    Interrupted(u64, #[source] Interrupted),
    /// A file cannot be read, written or used.
    #[error(transparent)]
    File(#[from] FileError),
    /// The checkpoint is of another training: name of the field that differs, its value in the checkpoint, and on the
    /// command line.
    #[error("the checkpoint was made with {0} {1}, not {2}")]
    OtherTraining(&'static str, String, String),
    /// The loss has diverged.
    #[error("the gradient was not finite {0} times in a row; try a lower learning rate")]
    Diverged(u32),
    /// A thread that prepares batches has ended.
    #[error("a thread that prepares batches has ended early")]
    LoaderGone,
    /// The tensor library failed.
    #[error("training: {}", first_line(.0))]
    Tensor(#[from] TchError),
}
