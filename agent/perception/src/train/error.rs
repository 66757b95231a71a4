//! Why a training ends early, whatever it trains.

use std::io;
use std::path::PathBuf;

use tch::TchError;

use super::checkpoint::CheckpointError;
use crate::torch_error::first_line;
use crate::weights::WeightsError;

/// Why a training ended early.
#[derive(Debug, thiserror::Error)]
pub enum TrainingError {
    /// The checkpoint cannot be written or continued.
    #[error(transparent)]
    Checkpoint(#[from] CheckpointError),
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
    #[error("the gradient was not finite {0} times in a row; try a lower learning rate")]
    Diverged(u32),
    /// A thread that prepares batches has died.
    #[error("a thread that prepares batches has ended early")]
    LoaderGone,
    /// Weights cannot be written.
    #[error(transparent)]
    Weights(#[from] WeightsError),
    /// A file cannot be read or written.
    #[error("{}: {source}", path.display())]
    Io {
        /// The file.
        path: PathBuf,
        /// What the system said.
        source: io::Error,
    },
    /// The tensor library refused.
    #[error("training: {}", first_line(.0))]
    Tensor(#[from] TchError),
}
