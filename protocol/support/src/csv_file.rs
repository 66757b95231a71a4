//! CSV files: rows under a known header with errors that state file, line and field, and texts written row by row.

use std::fmt::Display;
use std::ops::RangeInclusive;
use std::path::{Path, PathBuf};

use csv::{ReaderBuilder, StringRecord, Terminator, Trim, Writer, WriterBuilder};
use protocol::text::excerpt;

use crate::bounded_file;
use crate::file_error::{AtFile, FileError, Result};

/// Maximum number of characters of a foreign field or line in an error.
const SHOWN_CHARS: usize = 80;

/// A file with the expected header.
#[derive(Debug, Clone)]
pub struct CsvFile {
    path: PathBuf,
    header: &'static str,
    text: String,
}

/// One row of a file; blanks around its fields are removed.
#[derive(Debug, Clone)]
pub struct CsvRow<'a> {
    file: &'a CsvFile,
    line: u64,
    record: StringRecord,
}

impl CsvFile {
    /// Reads a file of at most `max_bytes` whose first line is `header`, the column names separated by commas.
    ///
    /// # Errors
    /// [`FileError`].
    pub fn read(path: &Path, header: &'static str, max_bytes: u64) -> Result<Self> {
        let text = bounded_file::read_text(path, max_bytes).at(path)?;
        let path = path.to_owned();
        Self { path, header, text }.checked()
    }

    fn checked(self) -> Result<Self> {
        let found = self.text.lines().next().unwrap_or_default().trim();
        if found == self.header {
            return Ok(self);
        }
        let found = excerpt(found, SHOWN_CHARS);
        let problem = format_args!("header is {found:?}, must be {:?}", self.header);
        Err(FileError::in_line(self.path, 1, problem))
    }

    /// The rows below the header; lines without content are skipped.
    pub fn rows(&self) -> impl Iterator<Item = CsvRow<'_>> {
        records(&self.text).skip(1).map(|(line, record)| CsvRow {
            file: self,
            line,
            record,
        })
    }
}

impl CsvRow<'_> {
    /// A field by its index; empty if the row is too short.
    pub fn field(&self, column: usize) -> &str {
        self.record.get(column).unwrap_or_default()
    }

    /// The row itself, if it has a field for every column.
    ///
    /// # Errors
    /// [`FileError`].
    pub fn complete(self) -> Result<Self> {
        let expected = self.file.header.split(',').count();
        if self.record.len() == expected {
            return Ok(self);
        }
        Err(self.fault(format_args!(
            "{:?} has {} columns, must be {expected}",
            self.shown(),
            self.record.len()
        )))
    }

    /// A field as a number within `range`; `must` describes the allowed numbers.
    ///
    /// # Errors
    /// [`FileError`] states the field.
    pub fn number(&self, column: usize, range: RangeInclusive<f64>, must: &str) -> Result<f64> {
        let number = self.field(column).parse().ok();
        let number = number.filter(|number| range.contains(number));
        number.ok_or_else(|| self.wrong(column, must))
    }

    /// The error for a field that is not valid.
    pub fn wrong(&self, column: usize, must: impl Display) -> FileError {
        let name = self.file.header.split(',').nth(column).unwrap_or_default();
        self.fault(format_args!(
            "{name} is {:?}, must be {must}",
            excerpt(self.field(column), SHOWN_CHARS)
        ))
    }

    /// The error for this row.
    pub fn fault(&self, problem: impl Display) -> FileError {
        FileError::in_line(&self.file.path, self.line, problem)
    }

    fn shown(&self) -> String {
        let fields: Vec<&str> = self.record.iter().collect();
        excerpt(&fields.join(","), SHOWN_CHARS)
    }
}

/// Line number (from 1) and fields of every line of a text that has content. Rows may have different lengths.
pub fn records(text: &str) -> impl Iterator<Item = (u64, StringRecord)> {
    let mut reader = ReaderBuilder::new()
        .has_headers(false)
        .flexible(true)
        .trim(Trim::All)
        .terminator(Terminator::Any(b'\n'))
        .from_reader(text.as_bytes());
    let records = std::iter::from_fn(move || {
        let mut record = StringRecord::new();
        // Text in memory has no errors but the end.
        let is_there = reader.read_record(&mut record).unwrap_or(false);
        is_there.then_some(record)
    });
    records.filter_map(|record| {
        let position = record.position()?;
        // The reader skips empty lines after it has stored the position.
        let rest = text
            .as_bytes()
            .get(usize::try_from(position.byte()).ok()?..)?;
        let empty_lines = rest.iter().take_while(|byte| **byte == b'\n').count() as u64;
        let is_blank = record.iter().all(str::is_empty) && record.len() == 1;
        (!is_blank).then_some((position.line() + empty_lines, record))
    })
}

/// A CSV text that is written row by row; fields are quoted if necessary.
#[derive(Debug)]
pub struct CsvText(Writer<Vec<u8>>);

impl CsvText {
    /// A text that begins with `header`, the column names separated by commas.
    pub fn new(header: &str) -> Self {
        let mut text = Self::headless();
        text.row(header.split(',').map(str::trim));
        text
    }

    /// A text without a header.
    pub fn headless() -> Self {
        Self(WriterBuilder::new().flexible(true).from_writer(Vec::new()))
    }

    /// Appends a row.
    pub fn row(&mut self, fields: impl IntoIterator<Item: AsRef<[u8]>>) {
        // Writing to memory cannot fail.
        let _ = self.0.write_record(fields);
    }

    /// The whole text.
    pub fn finish(self) -> String {
        let bytes = self.0.into_inner().unwrap_or_default();
        String::from_utf8_lossy(&bytes).into_owned()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn file(text: &str) -> Result<CsvFile, FileError> {
        CsvFile {
            path: "a.csv".into(),
            header: "name,size_m",
            text: text.into(),
        }
        .checked()
    }

    #[test]
    fn quoted_fields_round_trip() {
        let mut text = CsvText::new("name, size_m");
        text.row(["a, \"b\"", "1.5"]);
        text.row(["no_pose"]);
        let text = text.finish();
        assert_eq!(text, "name,size_m\n\"a, \"\"b\"\"\",1.5\nno_pose\n");
        let file = file(&text).unwrap();
        let rows: Vec<CsvRow<'_>> = file.rows().collect();
        assert_eq!(
            (
                rows.len(),
                rows[0].field(0),
                rows[1].field(0),
                rows[1].field(1)
            ),
            (2, "a, \"b\"", "no_pose", "")
        );
        assert_eq!(rows[0].number(1, 0.0..=2.0, "0 to 2").unwrap(), 1.5);
    }

    #[test]
    fn lines_are_counted_with_blank_ones_and_either_line_end() {
        for text in [
            "name,size_m\n\n \na,1\n\nb,2",
            "name,size_m\r\n\r\n \r\na,1\r\n\r\nb,2\r\n",
        ] {
            let file = file(text).unwrap();
            let rows: Vec<(u64, String)> = file.rows().map(|row| (row.line, row.shown())).collect();
            assert_eq!(rows, [(4, "a,1".into()), (6, "b,2".into())], "{text:?}");
        }
    }

    #[test]
    fn an_error_states_file_line_field_and_both_values() {
        for (row, expected) in [
            ("a,2", "a.csv:2: size_m is \"2\", must be 0 to 1"),
            ("a,NaN", "a.csv:2: size_m is \"NaN\", must be 0 to 1"),
            ("a,1,2", "a.csv:2: \"a,1,2\" has 3 columns, must be 2"),
            ("\"a,1", "a.csv:2: \"a,1\" has 1 columns, must be 2"),
        ] {
            let file = file(&format!("name,size_m\n{row}\n")).unwrap();
            let row = file.rows().next().unwrap();
            let number = row
                .complete()
                .and_then(|row| row.number(1, 0.0..=1.0, "0 to 1"));
            assert_eq!(number.unwrap_err().to_string(), expected);
        }
        assert_eq!(
            file("x,y\n").unwrap_err().to_string(),
            "a.csv:1: header is \"x,y\", must be \"name,size_m\""
        );
        assert!(file("").is_err());
        let error = CsvFile::read(Path::new("/nowhere/a.csv"), "x", 9)
            .unwrap_err()
            .to_string();
        assert!(error.starts_with("/nowhere/a.csv: "), "{error}");
    }
}
