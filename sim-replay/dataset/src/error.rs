//! Read errors: faults of a dataset, with their position.

use std::fmt::Display;
use std::path::{Path, PathBuf};

/// The result of reading: a [`ReadError`] if nothing else is named.
pub(crate) type Result<T, E = ReadError> = std::result::Result<T, E>;

/// Reasons why a dataset, or a frame of it, cannot be read.
#[derive(Debug, thiserror::Error)]
pub enum ReadError {
    /// An error of the operating system.
    #[error("{}: {source}", path.display())]
    Io {
        /// The file or folder.
        path: PathBuf,
        /// Error of the operating system.
        source: std::io::Error,
    },
    /// A file has invalid content, or a folder no supported layout.
    #[error("{}{}: {}{reason}", path.display(), shown(":", *line, ""), shown("", field.as_ref(), ": "))]
    Malformed {
        /// The file or folder.
        path: PathBuf,
        /// The line, from 1, if the file has lines.
        line: Option<u64>,
        /// The field, for example `vehicles.4335.extent`.
        field: Option<String>,
        /// Found and expected value or contents.
        reason: String,
    },
    /// The agent has no frame at the tick: it joined later, has left, or its files are missing.
    /// The message names scenario, agent and tick.
    #[error("{0}")]
    Absent(String),
    /// The requested agent, tick or variant does not exist in the scenario. The message names the requested and the
    /// available ones.
    #[error("{0}")]
    NoSuch(String),
}

impl ReadError {
    /// A [`ReadError::Malformed`] of a whole file or folder.
    pub fn malformed(path: &Path, reason: impl Into<String>) -> Self {
        Self::malformed_at(path, None, None, reason)
    }

    /// The same, at a line, counted from 1, or in a field.
    pub(crate) fn malformed_at(
        path: &Path,
        line: Option<u64>,
        field: Option<&str>,
        reason: impl Into<String>,
    ) -> Self {
        Self::Malformed {
            path: path.to_owned(),
            line,
            field: field.map(str::to_owned),
            reason: reason.into(),
        }
    }

    /// A [`ReadError::Io`].
    pub fn io(path: &Path, source: std::io::Error) -> Self {
        Self::Io {
            path: path.to_owned(),
            source,
        }
    }

    /// The same error with its consequence at the end of the reason.
    #[must_use]
    pub(crate) fn with_consequence(mut self, consequence: &str) -> Self {
        if let Self::Malformed { reason, .. } = &mut self {
            *reason = format!("{reason}: {consequence}");
        }
        self
    }

    /// The file or folder at fault, if the error concerns one.
    pub fn path(&self) -> Option<&Path> {
        match self {
            Self::Io { path, .. } | Self::Malformed { path, .. } => Some(path),
            Self::NoSuch(_) | Self::Absent(_) => None,
        }
    }

    /// True if the only fault is that the agent has no frame at the tick.
    pub fn is_absent(&self) -> bool {
        matches!(self, Self::Absent(_))
    }
}

/// A part of a message between two texts; nothing where it is missing.
pub(crate) fn shown(before: &str, part: Option<impl Display>, after: &str) -> String {
    part.map_or_else(String::new, |part| format!("{before}{part}{after}"))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_message_names_file_line_and_field() {
        let error = ReadError::Malformed {
            path: "a/000069.pcd".into(),
            line: Some(10),
            field: Some("POINTS".into()),
            reason: "3 stated, 2 found".into(),
        };
        assert_eq!(
            error.to_string(),
            "a/000069.pcd:10: POINTS: 3 stated, 2 found"
        );
        assert_eq!(
            ReadError::malformed(Path::new("b.bin"), "empty").to_string(),
            "b.bin: empty"
        );
    }
}
