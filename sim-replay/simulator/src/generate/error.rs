//! Errors of scene generation.

use std::path::PathBuf;

use protocol::config::FieldError;
use support::file_error::FileError;

/// Result of generating scenes: a [`SynthError`] if nothing else is named.
pub(crate) type Result<T, E = SynthError> = std::result::Result<T, E>;

/// Reasons why scenes could not be generated.
#[derive(Debug, thiserror::Error)]
pub enum SynthError {
    /// A map, or the settings that are recorded with generated scenes, cannot be used.
    #[error(transparent)]
    File(#[from] FileError),
    /// The output folder is not empty.
    #[error("{} is not empty; --force writes into it anyway", .0.display())]
    NotEmpty(PathBuf),
    /// Cached scenes do not match the options: their folder, the first setting that differs, and both values.
    #[error("{0}")]
    Kept(String),
    /// A file or folder could not be written.
    #[error(transparent)]
    Write(FileError),
    /// A layout cannot hold a scene.
    /// The message names the layout and the property of the scene.
    #[error("layout {0}")]
    Layout(String),
    /// An option is invalid.
    #[error(transparent)]
    Option(#[from] FieldError),
    /// The road network has no place for a vehicle.
    #[error("map {0} has no lane long enough to start from")]
    NoRoad(String),
    /// Too few vehicles stay near the ego: the scenario, both numbers and the distance.
    #[error("{0}")]
    TooFewCompanions(String),
}
