//! File error: the path of a file and what is wrong with it.

use std::any::Any;
use std::fmt::Display;
use std::io::{self, ErrorKind};
use std::path::{Path, PathBuf};

/// Result of an operation on a file: a [`FileError`] if nothing else is named.
pub type Result<T, E = FileError> = std::result::Result<T, E>;

/// A file that cannot be read, written or used.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("{}{}: {problem}", .path.display(), .line.map(|line| format!(":{line}")).unwrap_or_default())]
pub struct FileError {
    /// Path of the file.
    pub path: PathBuf,
    /// Number of the line that is wrong, from 1; absent: the whole file.
    pub line: Option<u64>,
    /// Entry that is wrong, the value found and the values allowed; or the error of the system.
    pub problem: String,
    /// Set where the disk is full, which no input causes.
    #[source]
    pub no_space: Option<NoSpace>,
}

/// The disk or the quota is full: the cause of an error that is not one of the input.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[error("No space left")]
pub struct NoSpace;

impl NoSpace {
    /// The cause, if `error` is one of the system and says so.
    pub fn of(error: &(dyn Any + 'static)) -> Option<Self> {
        let kind = error.downcast_ref::<io::Error>()?.kind();
        matches!(kind, ErrorKind::StorageFull | ErrorKind::QuotaExceeded).then_some(Self)
    }
}

impl FileError {
    /// An error about the file at `path`.
    pub fn new(path: impl Into<PathBuf>, problem: impl Display) -> Self {
        Self {
            path: path.into(),
            line: None,
            problem: problem.to_string(),
            no_space: None,
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

/// Refuses a file in place of a folder, or of one above it; the folder need not exist.
///
/// # Errors
/// [`FileError`] names the file.
pub fn check_folder(path: &Path) -> Result<()> {
    match path.ancestors().find(|folder| folder.is_file()) {
        Some(file) => Err(FileError::new(file, "is a file, must be a folder")),
        None => Ok(()),
    }
}

/// Results whose error gets the path of its file.
pub trait AtFile<T> {
    /// The result with an error that names the file.
    ///
    /// # Errors
    /// [`FileError`] in place of the error there was.
    fn at(self, path: &Path) -> Result<T, FileError>;
}

impl<T, E: Display + 'static> AtFile<T> for Result<T, E> {
    fn at(self, path: &Path) -> Result<T, FileError> {
        self.map_err(|error| FileError {
            no_space: NoSpace::of(&error),
            ..FileError::new(path, error)
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_file_is_refused_in_place_of_a_folder() {
        let root = tempfile::tempdir().unwrap();
        let file = root.path().join("a.yaml");
        std::fs::write(&file, "").unwrap();
        for path in [&file, &file.join("runs/b")] {
            let message = check_folder(path).unwrap_err().to_string();
            assert!(
                message.ends_with("/a.yaml: is a file, must be a folder"),
                "{message}"
            );
        }
        check_folder(root.path()).unwrap();
        check_folder(&root.path().join("none")).unwrap();
    }

    #[test]
    fn an_error_begins_with_its_file() {
        let error = "x".parse::<u8>().at(Path::new("a/b.csv")).unwrap_err();
        assert_eq!(error.to_string(), "a/b.csv: invalid digit found in string");
        let full: io::Result<()> = Err(ErrorKind::StorageFull.into());
        assert_eq!(
            full.at(Path::new("a.csv")).unwrap_err().no_space,
            Some(NoSpace)
        );
        let error = FileError::in_line("a.csv", 3, "x is 7, must be 0");
        assert_eq!(error.to_string(), "a.csv:3: x is 7, must be 0");
    }
}
