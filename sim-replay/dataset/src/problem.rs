//! Findings about data that was left out: place and reason, comparable and serializable.

use std::fmt::{self, Display};
use std::path::Path;

use serde::{Deserialize, Serialize};

use super::ReadError;

/// A fault of a data set that did not stop the reading: the part is left out, the rest is used.
#[derive(Debug, Clone, Default, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
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

impl Problem {
    /// A finding about a field of data as a whole; the message begins with their path.
    pub(crate) fn about(path: &str, field: &str, reason: &str) -> Self {
        Self {
            path: path.to_owned(),
            line: None,
            field: Some(field.to_owned()),
            message: format!("{path}: {reason}"),
        }
    }

    /// A part of a frame, for example `object`, that cannot be read.
    pub(crate) fn left_out(part: &str, error: ReadError) -> Self {
        Self::from(&error.with_consequence(&format!("the {part} is left out")))
    }
}

/// Largest number of faults that one error lists.
const LISTED: usize = 5;

/// The first faults as one text, and the number of the others.
pub(crate) fn listed<P: Display>(problems: impl IntoIterator<Item = P>) -> String {
    let mut problems = problems.into_iter();
    let first = problems.by_ref().take(LISTED).map(|one| one.to_string());
    let first = first.collect::<Vec<_>>().join("; ");
    match problems.count() {
        0 => first,
        more => format!("{first}; and {more} more"),
    }
}

/// The first faults in brackets, for an error about data of which nothing is left; empty without any.
pub fn reasons<P: Display>(problems: impl IntoIterator<Item = P>) -> String {
    match listed(problems) {
        text if text.is_empty() => text,
        text => format!(" ({text})"),
    }
}

impl fmt::Display for Problem {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.message)
    }
}

impl From<&ReadError> for Problem {
    fn from(error: &ReadError) -> Self {
        let (line, field) = match error {
            ReadError::Malformed { line, field, .. } => (*line, field.clone()),
            _ => (None, None),
        };
        Self {
            path: error.path().unwrap_or(Path::new("")).display().to_string(),
            line,
            field,
            message: error.to_string(),
        }
    }
}
