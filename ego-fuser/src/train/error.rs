//! Why a training ends early.

use std::path::PathBuf;

use agent::training::CheckpointError;

use crate::method::Method;
use crate::model::ModelError;
use crate::samples::SampleError;

/// Why a training ended early.
#[derive(Debug, thiserror::Error)]
pub enum TrainError {
    /// The model cannot be built or run.
    #[error(transparent)]
    Model(#[from] ModelError),
    /// There is no next sample.
    #[error(transparent)]
    Sample(#[from] SampleError),
    /// The checkpoint cannot be written or continued.
    #[error(transparent)]
    Checkpoint(#[from] CheckpointError),
    /// The method cannot be trained.
    #[error("method {0} exchanges boxes and is not trained; train `none` and use its weights")]
    NotTrained(Method),
    /// The checkpoint is of another training.
    #[error("the checkpoint was made with {field} {found}, not {asked}")]
    OtherTraining {
        /// What differs.
        field: &'static str,
        /// In the checkpoint.
        found: String,
        /// On the command line.
        asked: String,
    },
    /// The loss has left the numbers.
    #[error("the loss was not finite {0} times in a row; try a lower learning rate")]
    Diverged(u32),
    /// A file cannot be written.
    #[error("{}: {source}", path.display())]
    Io {
        /// The file.
        path: PathBuf,
        /// What the system said.
        source: std::io::Error,
    },
    /// The picture of the curve cannot be written.
    #[error(transparent)]
    Picture(#[from] agent::canvas::CanvasError),
    /// The tensor library refused.
    #[error("training: {0}")]
    Torch(#[from] tch::TchError),
}
