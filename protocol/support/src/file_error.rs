//! File error: the path of a file and what is wrong with it.

use std::error::Error;
use std::fmt::{self, Display};
use std::path::{Path, PathBuf};

/// A file that cannot be read, written or used.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct FileError {
    /// Path of the file.
    pub path: PathBuf,
    /// Number of the line that is wrong, from 1; absent: the whole file.
    pub line: Option<u64>,
    /// Entry that is wrong, the value found and the values allowed; or the error of the system.
    pub problem: String,
}

impl FileError {
    /// An error about the file at `path`.
    pub fn new(path: impl Into<PathBuf>, problem: impl Display) -> Self {
        Self {
            path: path.into(),
            line: None,
            problem: problem.to_string(),
        }
    }

    /// An error about a line of the file at `path`, counted from 1.
    pub fn in_line(path: impl Into<PathBuf>, line: u64, problem: impl Display) -> Self {
        Self {
            line: Some(line),
            ..Self::new(path, problem)
        }
    }
}

impl Display for FileError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}", self.path.display())?;
        if let Some(line) = self.line {
            write!(f, ":{line}")?;
        }
        write!(f, ": {}", self.problem)
    }
}

impl Error for FileError {}

/// Results whose error gets the path of its file.
pub trait AtFile<T> {
    /// The result with an error that names the file.
    ///
    /// # Errors
    /// [`FileError`] in place of the error there was.
    fn at(self, path: &Path) -> Result<T, FileError>;
}

impl<T, E: Display> AtFile<T> for Result<T, E> {
    fn at(self, path: &Path) -> Result<T, FileError> {
        self.map_err(|error| FileError::new(path, error))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_error_begins_with_its_file() {
        let error = "x".parse::<u8>().at(Path::new("a/b.csv")).unwrap_err();
        assert_eq!(error.to_string(), "a/b.csv: invalid digit found in string");
        let error = FileError::in_line("a.csv", 3, "x is 7, must be 0");
        assert_eq!(error.to_string(), "a.csv:3: x is 7, must be 0");
    }
}
