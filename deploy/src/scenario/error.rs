//! Errors of scenario files.

use std::path::PathBuf;

use bus::config_file::ConfigError;

/// Why a scenario cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum ScenarioError {
    /// The file cannot be read, is no scenario, or has a value that is not allowed.
    #[error(transparent)]
    File(#[from] ConfigError),
    /// A path names nothing.
    #[error("{}: {field}: {} does not exist", path.display(), missing.display())]
    Missing {
        /// The scenario file.
        path: PathBuf,
        /// The field, with its parents.
        field: &'static str,
        /// The file or folder that is not there.
        missing: PathBuf,
    },
}
