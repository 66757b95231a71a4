//! Table of measured pose errors of a pose generator, one row per sweep.

use std::path::Path;

use support::csv_file::{CsvFile, CsvRow};
use support::file_error::FileError;

use super::noise::PlanarError;

/// The first line of a table.
const HEADER: &str = "x_m,y_m,z_m,yaw_deg,confidence";

/// Largest error of a pose, metres: a larger one is an error of the file.
const MAX_ERROR_M: f64 = 1e5;
/// Largest file that is read, bytes.
const MAX_BYTES: u64 = 64 << 20;

/// Result of one sweep: error of its pose in position and heading, in the vehicle's frame (x forward, y left), and
/// confidence of the generator, 0..=1; `None`: no pose.
pub type TableRow = Option<(PlanarError, f32)>;

/// Rows in the order of the sweeps they were measured on.
///
/// The file is text: the header `x_m,y_m,z_m,yaw_deg,confidence`, then a line of five numbers per sweep, or `no_pose`.
#[derive(Debug, Clone, PartialEq)]
pub struct ErrorTable {
    rows: Vec<TableRow>,
}

impl ErrorTable {
    /// Reads a table.
    ///
    /// # Errors
    /// [`FileError`] names the file, the line and the column.
    pub fn read(path: &Path) -> Result<Self, FileError> {
        let file = CsvFile::read(path, HEADER, MAX_BYTES)?;
        let rows: Vec<TableRow> = file.rows().map(parse_row).collect::<Result<_, _>>()?;
        if rows.is_empty() {
            return Err(FileError::new(path, "no row below the header"));
        }
        Ok(Self { rows })
    }

    /// The row of a step if the first step has row `start`; after the last row comes the first one.
    pub fn row(&self, start: u64, step: u64) -> TableRow {
        let length = self.rows.len() as u64;
        // Both are reduced first: `start` is a hash of 64 bits, and the plain sum can overflow.
        self.rows[((start % length + step % length) % length) as usize]
    }
}

fn parse_row(row: CsvRow<'_>) -> Result<TableRow, FileError> {
    // Such a line has one field only: it is read before the number of fields is checked.
    if row.field(0) == "no_pose" {
        return Ok(None);
    }
    let row = row.complete()?;
    let mut position_m = [0.0; 3];
    for (column, metres) in position_m.iter_mut().enumerate() {
        *metres = row.number(column, -MAX_ERROR_M..=MAX_ERROR_M, "metres within 100 km")?;
    }
    let yaw_deg = row.number(3, -360.0..=360.0, "degrees within a turn")?;
    let yaw_rad = yaw_deg.to_radians();
    let confidence = row.number(4, 0.0..=1.0, "0 to 1")? as f32;
    let error = PlanarError {
        position_m,
        yaw_rad,
    };
    Ok(Some((error, confidence)))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn read(text: &str) -> Result<ErrorTable, FileError> {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("errors.csv");
        std::fs::write(&path, text).unwrap();
        ErrorTable::read(&path)
    }

    #[test]
    fn rows_repeat_after_the_last() {
        let table = read("x_m,y_m,z_m,yaw_deg,confidence\n0.1,0,0,180,0.5\nno_pose\n\n").unwrap();
        let Some((error, confidence)) = table.row(1, 1) else {
            panic!("{table:?}")
        };
        assert!((error.yaw_rad - std::f64::consts::PI).abs() < 1e-12 && confidence == 0.5);
        assert_eq!(table.row(0, 1), None);
        assert_eq!(table.row(u64::MAX, u64::MAX), table.row(0, 0));
    }

    #[test]
    fn errors_name_file_line_and_column() {
        let header = "x_m,y_m,z_m,yaw_deg,confidence\n";
        for (text, parts) in [
            ("a,b\n".to_owned(), ["errors.csv:1", "a,b"]),
            (format!("{header}1,2,3\n"), ["errors.csv:2", "1,2,3"]),
            (
                format!("{header}0,0,0,0,1\n0,NaN,0,0,1\n"),
                ["errors.csv:3", "y_m is \"NaN\""],
            ),
            (
                format!("{header}0,0,0,0,1.5\n"),
                ["errors.csv:2", "confidence is \"1.5\""],
            ),
            (header.to_owned(), ["errors.csv", "no row"]),
        ] {
            let message = read(&text).unwrap_err().to_string();
            assert!(parts.iter().all(|part| message.contains(part)), "{message}");
        }
        let message = ErrorTable::read(Path::new("/nowhere/errors.csv"))
            .unwrap_err()
            .to_string();
        assert!(message.contains("/nowhere/errors.csv"), "{message}");
    }
}
