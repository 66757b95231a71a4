//! Error of training, evaluating or mapping.

use std::path::PathBuf;

use dataset::ReadError;
use localization::pgc::LocalizerError;
use perception::torch_error::first_line;
use perception::train::TrainingError;
use perception::weights::FileError;
use tch::TchError;

/// Result of training, evaluating or mapping: a [`Error`] if nothing else is named.
pub(crate) type Result<T, E = Error> = std::result::Result<T, E>;

/// Error that ends a training, an evaluation or a map early.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// A scene cannot be read.
    #[error(transparent)]
    Read(#[from] ReadError),
    /// A file cannot be read, written or used.
    #[error(transparent)]
    File(#[from] FileError),
    /// No folder holds a sweep with a known pose; the faults that were found in brackets.
    #[error("no sweep with a pose in {folders}{1}", folders = listed(.0))]
    NoSweeps(Vec<PathBuf>, String),
    /// The input cannot be used; the text names it, and what is needed.
    #[error("{0}")]
    Input(String),
    /// A network cannot be built, loaded or run.
    #[error(transparent)]
    Localizer(#[from] LocalizerError),
    /// The training itself failed.
    #[error(transparent)]
    Training(#[from] TrainingError),
    /// The tensor library failed.
    #[error("training: {}", first_line(.0))]
    Tensor(#[from] TchError),
}

/// Folders as one text.
pub(crate) fn listed(folders: &[PathBuf]) -> String {
    if folders.is_empty() {
        return "the drives".to_owned();
    }
    let folders = folders.iter().map(|folder| folder.display().to_string());
    folders.collect::<Vec<_>>().join(", ")
}

impl Error {
    /// True if the input is at fault.
    pub fn is_bad_input(&self) -> bool {
        matches!(self, Self::Read(_) | Self::NoSweeps(..) | Self::Input(_))
    }
}
