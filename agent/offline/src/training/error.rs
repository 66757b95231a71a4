//! Errors of a training of a localizer.

use std::path::PathBuf;

use dataset::ReadError;

use localization::pgc::LocalizerError;
use perception::train::TrainingError;

/// Error that ends a training early.
#[derive(Debug, thiserror::Error)]
pub enum LocalizerTrainError {
    /// A scene cannot be read.
    #[error(transparent)]
    Read(#[from] ReadError),
    /// No folder holds a sweep with a known pose.
    #[error("no sweep with a pose in {0:?}")]
    NoSweeps(Vec<PathBuf>),
    /// Sweeps do not overlap, so there are no correspondences to learn from.
    #[error("no two sweeps of one world within {0} m of each other")]
    NoPairs(f64),
    /// Sweeps overlap in range, but none has a cell in common with another one.
    #[error(
        "{0} pairs of sweeps side by side have no cell at the same spot: are the sweeps empty?"
    )]
    NoMatches(usize),
    /// A head to start from finds its way in none of the sweeps.
    #[error("the head of {0:?} recognises none of the sweeps: are they of another scene?")]
    OtherScene(String),
    /// The network cannot be built or run.
    #[error(transparent)]
    Localizer(#[from] LocalizerError),
    /// The training itself failed.
    #[error(transparent)]
    Training(#[from] TrainingError),
    /// The tensor library failed.
    #[error("training: {}", perception::torch_error::first_line(.0))]
    Tensor(#[from] tch::TchError),
}
