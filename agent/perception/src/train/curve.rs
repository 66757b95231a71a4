//! Training curve as CSV.

use std::fs::{File, OpenOptions};
use std::io::Write;
use std::path::{Path, PathBuf};

use support::atomic_file;
use support::bounded_file::{self, MAX_TEXT_BYTES};
use support::file_error::{AtFile, FileError};

/// Appends rows that begin with the step; every row is on disk when the call returns.
#[derive(Debug)]
pub struct Curve {
    path: PathBuf,
    file: File,
}

impl Curve {
    /// Creates a file, or continues the one there is from the step of a checkpoint: later rows are of steps that will
    /// be repeated.
    ///
    /// # Errors
    /// [`FileError`] when the file cannot be read or written.
    pub fn open(path: &Path, header: &str, checkpoint: Option<u64>) -> Result<Self, FileError> {
        let kept = match checkpoint {
            Some(step) if path.exists() => rows_until(
                &bounded_file::read_text(path, MAX_TEXT_BYTES).at(path)?,
                step,
            ),
            _ => format!("{header}\n"),
        };
        atomic_file::write(path, kept).at(path)?;
        let file = OpenOptions::new().append(true).open(path).at(path)?;
        let path = path.to_owned();
        Ok(Self { path, file })
    }

    /// Path of the file.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Appends a row of formatted cells.
    ///
    /// # Errors
    /// [`FileError`] when the file cannot be written.
    pub fn row(&mut self, row: &str) -> Result<(), FileError> {
        let written = self.file.write_all(format!("{row}\n").as_bytes());
        // A checkpoint is never of a later step than the rows that a power cut leaves.
        written.and_then(|()| self.file.sync_data()).at(&self.path)
    }

    /// Appends a row of numbers.
    ///
    /// # Errors
    /// As [`Self::row`].
    pub fn numbers(&mut self, values: &[f64]) -> Result<(), FileError> {
        let cells: Vec<String> = values.iter().map(|value| format!("{value:.5}")).collect();
        self.row(&cells.join(","))
    }
}

/// The header and all rows up to `step`; a truncated last row is left out.
fn rows_until(csv: &str, step: u64) -> String {
    let rows = csv.split_inclusive('\n').enumerate();
    let kept = rows.filter(|(place, row)| {
        let first = row.split(',').next();
        let first = first.and_then(|cell| cell.parse::<f64>().ok());
        *place == 0 || (row.ends_with('\n') && first.is_some_and(|found| found <= step as f64))
    });
    kept.map(|(_, row)| row).collect()
}

#[cfg(test)]
mod tests {
    use std::fs;

    use super::*;

    #[test]
    fn a_resumed_training_writes_no_step_twice() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("curve.csv");
        let mut first = Curve::open(&path, "step,loss", None).unwrap();
        for step in [10.0, 20.0, 30.0] {
            first.numbers(&[step, 0.5]).unwrap();
        }
        // The process ended here, in the middle of a row.
        write!(first.file, "4").unwrap();
        drop(first);
        let mut resumed = Curve::open(&path, "step,loss", Some(20)).unwrap();
        resumed.row("30,again").unwrap();
        let text = fs::read_to_string(&path).unwrap();
        assert_eq!(
            text,
            "step,loss\n10.00000,0.50000\n20.00000,0.50000\n30,again\n"
        );

        drop(Curve::open(&path, "step,loss", None).unwrap());
        assert_eq!(
            fs::read_to_string(&path).unwrap(),
            "step,loss\n",
            "a new training begins a new curve"
        );
        let elsewhere = folder.path().join("other.csv");
        drop(Curve::open(&elsewhere, "step,loss", Some(7)).unwrap());
        assert_eq!(fs::read_to_string(&elsewhere).unwrap(), "step,loss\n");
    }
}
