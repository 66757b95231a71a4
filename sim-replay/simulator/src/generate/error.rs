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
    /// Cached scenes do not match the options.
    #[error("{} holds scenes made with {setting} {found}, not {wanted}; take another folder, or remove it", folder.display())]
    Kept {
        /// Folder of the cached scenes.
        folder: PathBuf,
        /// The first setting that differs.
        setting: &'static str,
        /// Value with which they were made.
        found: String,
        /// Requested value.
        wanted: String,
    },
    /// A file or folder could not be written.
    #[error(transparent)]
    Write(FileError),
    /// A layout cannot hold a scene.
    #[error("layout {layout}: {reason}")]
    Layout {
        /// The layout's name.
        layout: &'static str,
        /// Property of the scene that the layout cannot hold.
        reason: String,
    },
    /// An option is invalid.
    #[error(transparent)]
    Option(#[from] FieldError),
    /// The road network has no place for a vehicle.
    #[error("map {0} has no lane long enough to start from")]
    NoRoad(String),
    /// Too few vehicles stay near the ego.
    #[error(
        "scene {scenario}: {found} vehicles stay within {range_m} m of the ego, {wanted} are wanted; fewer --vehicles or --frames help"
    )]
    TooFewCompanions {
        /// The scenario.
        scenario: String,
        /// Number of companions found.
        found: usize,
        /// Number of companions needed.
        wanted: usize,
        /// Distance from the ego within which they have to stay, metres.
        range_m: f64,
    },
}
