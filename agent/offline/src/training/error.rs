//! Why a training of a localizer ends early.

use std::path::PathBuf;

use dataset::ReadError;

use localization::pgc::LocalizerError;
use perception::train::TrainingError;

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
    /// The training itself has failed.
    #[error(transparent)]
    Training(#[from] TrainingError),
    /// The tensor library refused.
    #[error("training: {}", perception::torch_error::first_line(.0))]
    Tensor(#[from] tch::TchError),
}
