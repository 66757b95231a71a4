//! Errors of scenario files.

use std::path::PathBuf;

use bus::config_file::ConfigError;
use perception::weights::FileError;

/// Reason why a scenario cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum ScenarioError {
    /// The file cannot be read, is no scenario, or has a value that is not allowed.
    #[error(transparent)]
    File(#[from] ConfigError),
    /// The networks of a pose source are not found.
    #[error("{}: agents.pose: {source}", path.display())]
    Head {
        /// Path of the scenario file.
        path: PathBuf,
        /// The head, or the encoder that is missing.
        source: FileError,
    },
    /// A path does not exist.
    #[error("{}: {field}: {} does not exist", path.display(), missing.display())]
    Missing {
        /// Path of the scenario file.
        path: PathBuf,
        /// The field, with its parents.
        field: &'static str,
        /// The missing file or folder.
        missing: PathBuf,
    },
}
