//! Findings about data that was left out: place and reason, comparable and serializable.

use std::path::Path;

use serde::{Deserialize, Serialize};

use super::ReadError;

/// A fault of a data set that did not stop the reading: the part is left out, the rest is used.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
pub struct Problem {
    /// The file or folder.
    pub path: String,
    /// The line, from 1, if the file has lines.
    pub line: Option<u64>,
    /// The field.
    pub field: Option<String>,
    /// The finding, with position and both values.
    pub message: String,
}

impl From<&ReadError> for Problem {
    fn from(error: &ReadError) -> Self {
        Self {
            path: error.path().unwrap_or(Path::new("")).display().to_string(),
            line: error.line(),
            field: error.field().map(str::to_owned),
            message: error.to_string(),
        }
    }
}
