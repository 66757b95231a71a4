//! The course of a training as CSV.

use std::fs::{File, OpenOptions};
use std::io::Write;
use std::path::{Path, PathBuf};

use super::error::LocalizerTrainError;

/// Appends rows; every row is on disk when the call returns.
#[derive(Debug)]
pub(super) struct Curve {
    path: PathBuf,
    file: File,
}

impl Curve {
    pub(super) fn open(path: &Path, header: &str, resume: bool) -> Result<Self, LocalizerTrainError> {
        let io = |source| LocalizerTrainError::Io { path: path.to_owned(), source };
        let is_new = !(resume && path.exists());
        let file =
            OpenOptions::new().create(true).write(true).append(!is_new).truncate(is_new).open(path).map_err(io)?;
        let mut curve = Self { path: path.to_owned(), file };
        if is_new {
            curve.line(header)?;
        }
        Ok(curve)
    }

    pub(super) fn row(&mut self, values: &[f64]) -> Result<(), LocalizerTrainError> {
        let cells: Vec<String> = values.iter().map(|value| format!("{value:.5}")).collect();
        self.line(&cells.join(","))
    }

    fn line(&mut self, line: &str) -> Result<(), LocalizerTrainError> {
        writeln!(self.file, "{line}").map_err(|source| LocalizerTrainError::Io { path: self.path.clone(), source })
    }
}
