//! Errors of recordings.

use std::path::{Path, PathBuf};

use support::file_error::FileError;

use super::OWN_ENCODING;

/// Result of reading or writing a recording: a [`RecordingError`] if nothing else is named.
pub type Result<T, E = RecordingError> = std::result::Result<T, E>;

/// Reasons why a recording cannot be written or read.
#[derive(Debug, thiserror::Error)]
pub enum RecordingError {
    /// An error of the operating system.
    #[error("recording {}: {source}", path.display())]
    Io {
        /// The file.
        path: PathBuf,
        /// Error of the operating system.
        source: std::io::Error,
    },
    /// The file is an MCAP file of another program.
    #[error(
        "{}: no recording of v2vloc: it has no channel of encoding {OWN_ENCODING:?}{what}; sweeps and poses of a bag of \
         ROS 2 are read wherever a data set is", path.display()
    )]
    Foreign {
        /// The file.
        path: PathBuf,
        /// Its first damage, if any.
        what: String,
    },
    /// The file is no MCAP file, or none of its messages can be read.
    #[error(transparent)]
    NotOurs(FileError),
    /// A record of the file is invalid.
    #[error("{}, byte {offset}: {reason}", path.display())]
    Malformed {
        /// The file.
        path: PathBuf,
        /// Start of the record, bytes.
        offset: u64,
        /// Found and expected value.
        reason: String,
    },
    /// Writing failed before; the chunks written until then are complete.
    #[error("recording {} has ended: {reason}", path.display())]
    Ended {
        /// The file.
        path: PathBuf,
        /// Reason of the failure.
        reason: String,
    },
}

impl RecordingError {
    pub(super) fn io(path: &Path) -> impl FnOnce(std::io::Error) -> Self {
        move |source| Self::Io {
            path: path.into(),
            source,
        }
    }

    pub(super) fn foreign(path: &Path, what: String) -> Self {
        Self::Foreign {
            path: path.into(),
            what,
        }
    }

    pub(super) fn not_ours(path: &Path, reason: impl std::fmt::Display) -> Self {
        Self::NotOurs(FileError::new(path, reason))
    }
}
