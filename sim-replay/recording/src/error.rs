//! What can be wrong with a recording.

use std::path::{Path, PathBuf};

/// Why a recording cannot be written or read.
#[derive(Debug, thiserror::Error)]
pub enum RecordingError {
    /// The operating system refused.
    #[error("recording {}: {source}", path.display())]
    Io {
        /// The file.
        path: PathBuf,
        /// What the system says.
        source: std::io::Error,
    },
    /// The file is no MCAP file, or none of ours.
    #[error("{}: {reason}", path.display())]
    NotOurs {
        /// The file.
        path: PathBuf,
        /// What was looked for and found.
        reason: String,
    },
    /// A record of the file says something that cannot be.
    #[error("{}, byte {offset}: {reason}", path.display())]
    Malformed {
        /// The file.
        path: PathBuf,
        /// Where the record begins.
        offset: u64,
        /// What was found and what was expected.
        reason: String,
    },
    /// Writing failed before; what was written until then is whole.
    #[error("recording {} has ended: {reason}", path.display())]
    Ended {
        /// The file.
        path: PathBuf,
        /// Why it ended.
        reason: String,
    },
}

impl RecordingError {
    pub(super) fn io(path: &Path, source: std::io::Error) -> Self {
        Self::Io { path: path.into(), source }
    }

    pub(super) fn malformed(path: &Path, offset: u64, reason: impl Into<String>) -> Self {
        Self::Malformed { path: path.into(), offset, reason: reason.into() }
    }
}
