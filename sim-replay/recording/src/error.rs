//! Errors of recordings.

use std::path::{Path, PathBuf};

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
    /// The file is no MCAP file, or not a recording of this program.
    #[error("{}: {reason}", path.display())]
    NotOurs {
        /// The file.
        path: PathBuf,
        /// Expected and found content.
        reason: String,
    },
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
    pub(super) fn io(path: &Path, source: std::io::Error) -> Self {
        Self::Io {
            path: path.into(),
            source,
        }
    }

    pub(super) fn malformed(path: &Path, offset: u64, reason: impl Into<String>) -> Self {
        Self::Malformed {
            path: path.into(),
            offset,
            reason: reason.into(),
        }
    }
}
