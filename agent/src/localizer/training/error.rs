//! Why a training of a localizer ends early.

use std::path::PathBuf;

use sim_replay::dataset::ReadError;

use crate::localizer::LocalizerError;
use crate::training::CheckpointError;
use crate::weights::WeightsError;

/// Why a training ended early.
#[derive(Debug, thiserror::Error)]
pub enum LocalizerTrainError {
    /// A scene cannot be read.
    #[error(transparent)]
    Read(#[from] ReadError),
    /// No folder holds a sweep whose pose is known.
    #[error("no sweep with a pose in {0:?}")]
    NoSweeps(Vec<PathBuf>),
    /// Sweeps do not overlap, so there is nothing to learn correspondences from.
    #[error("no two sweeps of one world within {0} m of each other")]
    NoPairs(f64),
    /// Sweeps overlap, but none shows what another one shows.
    #[error("{0} pairs of sweeps side by side have no cell at the same spot: are the sweeps empty?")]
    NoMatches(usize),
    /// The network cannot be built or run.
    #[error(transparent)]
    Localizer(#[from] LocalizerError),
    /// Weights cannot be read or written.
    #[error(transparent)]
    Weights(#[from] WeightsError),
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
    /// A file cannot be written.
    #[error("{}: {source}", path.display())]
    Io {
        /// The file.
        path: PathBuf,
        /// What the system said.
        source: std::io::Error,
    },
    /// The tensor library refused.
    #[error("training: {}", crate::detector::first_line(.0))]
    Tensor(#[from] tch::TchError),
}
