//! Tables in JSON: lists of rows in files of up to gigabytes, read one row at a time.

use std::borrow::Cow;
use std::io::{BufRead, BufReader, Read};
use std::path::Path;

use serde::Deserialize;

use super::json::{self, JsonField};
use super::{ReadError, Result, files};
use support::bounded_file;

/// Bytes read at once.
const BUFFER_BYTES: usize = 1 << 20;
/// Largest row, bytes.
const MAX_ROW_BYTES: usize = 1 << 20;
/// Unusable rows that are reported one by one; further ones are counted.
const MAX_PROBLEMS: usize = 20;

/// Tokens of a row, by which needed rows of large tables are selected before the rest is parsed.
#[derive(Debug, Default, Deserialize)]
#[serde(default)]
pub(super) struct RowKeys<'a> {
    #[serde(borrow)]
    pub(super) token: Cow<'a, str>,
    #[serde(borrow)]
    pub(super) calibrated_sensor_token: Cow<'a, str>,
    pub(super) is_key_frame: Option<bool>,
}

/// The same as [`read`], with every row.
pub(super) fn read_all(
    path: &Path,
    max_bytes: u64,
    problems: &mut Vec<ReadError>,
    row: impl FnMut(&JsonField<'_>) -> Result<()>,
) -> Result<usize> {
    read(path, max_bytes, problems, |_| true, row)
}

/// Reads a table: a file of at most `max_bytes` that holds one list. Its rows are passed on one at a time; the list is
/// never in memory as a whole. An unusable row, or a truncated file, is a problem, and the other rows are used.
///
/// Returns the number of usable rows.
///
/// # Errors
/// If the file cannot be read, is larger, or is broken before its first usable row.
pub(super) fn read(
    path: &Path,
    max_bytes: u64,
    problems: &mut Vec<ReadError>,
    is_needed: impl Fn(&RowKeys<'_>) -> bool,
    mut row: impl FnMut(&JsonField<'_>) -> Result<()>,
) -> Result<usize> {
    let (mut used, mut unusable) = (0, 0);
    let whole = for_each_row(path, max_bytes, |index, raw| {
        // A row without valid keys is kept for its error message.
        let is_unneeded = match serde_json::from_slice(raw) {
            Ok(keys) => !is_needed(&keys),
            Err(_) => serde_json::from_slice(&json::with_quoted_words(raw))
                .is_ok_and(|keys| !is_needed(&keys)),
        };
        if is_unneeded {
            return;
        }
        let value = json::parse(raw).map_err(|error| {
            let reason = format!("no sound JSON: {error}");
            ReadError::malformed_at(path, None, Some(&index.to_string()), reason)
        });
        match value.and_then(|value| row(&JsonField::entry(path, index, &value))) {
            Ok(()) => used += 1,
            Err(problem) => {
                unusable += 1;
                // A table has up to millions of rows: all their problems would fill the memory.
                if unusable <= MAX_PROBLEMS {
                    problems.push(problem);
                }
            }
        }
    });
    if unusable > MAX_PROBLEMS {
        let reason = format!(
            "{unusable} entries cannot be used: left out; the first {MAX_PROBLEMS} are listed"
        );
        problems.push(ReadError::malformed(path, reason));
    }
    match whole {
        Err(error) if used == 0 => return Err(error),
        Err(error) => problems.push(error),
        Ok(()) => {}
    }
    Ok(used)
}

/// Passes on the entries of the list in the order of the file. An entry need not be valid: it ends when its brackets
/// are closed.
fn for_each_row(path: &Path, max_bytes: u64, mut entry: impl FnMut(usize, &[u8])) -> Result<()> {
    let file = bounded_file::open(path).map_err(|error| ReadError::io(path, error))?;
    let metadata = file.metadata();
    let size = metadata.map_err(|error| ReadError::io(path, error))?.len();
    if size > max_bytes {
        let reason = format!("{size} bytes: larger than {max_bytes} bytes, the most that is read");
        return Err(ReadError::malformed(path, reason));
    }
    // The limit also holds for a file that grows while it is read.
    let mut reader = BufReader::with_capacity(BUFFER_BYTES, file.take(max_bytes));
    let first = reader.fill_buf();
    if first.is_ok_and(|bytes| bytes.starts_with(files::BYTE_ORDER_MARK)) {
        reader.consume(files::BYTE_ORDER_MARK.len());
    }
    let mut list = RowSplitter::default();
    loop {
        let bytes = reader.fill_buf();
        let bytes = bytes.map_err(|error| ReadError::io(path, error))?;
        if bytes.is_empty() {
            return list.finish().map_err(|reason| list.error(path, reason));
        }
        let count = bytes.len();
        let pushed = list.push(bytes, &mut entry);
        pushed.map_err(|reason| list.error(path, reason))?;
        reader.consume(count);
    }
}

/// Splits the text of a list into its entries.
#[derive(Debug, Default)]
struct RowSplitter {
    /// The entry that has begun.
    entry: Vec<u8>,
    count: usize,
    /// Depth of open brackets: 0 before and after the list.
    depth: usize,
    is_string: bool,
    is_escaped: bool,
    is_over: bool,
    /// Number of completed lines.
    lines: u64,
}

impl RowSplitter {
    fn push(&mut self, bytes: &[u8], entry: &mut impl FnMut(usize, &[u8])) -> Result<(), String> {
        for &byte in bytes {
            self.lines += u64::from(byte == b'\n');
            match byte {
                _ if self.depth == 0 => self.outside(byte)?,
                // Only commas of the list itself end an entry, not those in a row or in a text.
                b',' | b']' if self.depth == 1 && !self.is_string => self.end(byte, entry),
                _ => self.inside(byte)?,
            }
        }
        Ok(())
    }

    fn outside(&mut self, byte: u8) -> Result<(), String> {
        match byte {
            byte if byte.is_ascii_whitespace() => Ok(()),
            b'[' if !self.is_over => {
                self.depth = 1;
                Ok(())
            }
            _ if self.is_over => Err("more follows the list".into()),
            _ => Err(format!("{:?}, expected a list", char::from(byte))),
        }
    }

    fn inside(&mut self, byte: u8) -> Result<(), String> {
        match (self.is_string, byte) {
            (true, _) if self.is_escaped => self.is_escaped = false,
            (true, b'\\') => self.is_escaped = true,
            (_, b'"') => self.is_string = !self.is_string,
            (false, b'{' | b'[') => self.depth += 1,
            // The list itself stays open: it ends at its own bracket.
            (false, b'}' | b']') => self.depth = (self.depth - 1).max(1),
            _ => {}
        }
        // A row whose brackets are never closed would take the rest of the file into memory.
        if self.entry.len() == MAX_ROW_BYTES {
            let count = self.count;
            return Err(format!(
                "entry {count} is larger than {MAX_ROW_BYTES} bytes"
            ));
        }
        self.entry.push(byte);
        Ok(())
    }

    /// The end of an entry, or of the list.
    fn end(&mut self, byte: u8, entry: &mut impl FnMut(usize, &[u8])) {
        let is_last = byte == b']';
        let is_blank = self.entry.iter().all(u8::is_ascii_whitespace);
        // `[]` has no entry. A blank entry elsewhere is passed on, and its reader reports it.
        if !(is_last && is_blank && self.count == 0) {
            entry(self.count, &self.entry);
            self.count += 1;
        }
        self.entry.clear();
        if is_last {
            (self.depth, self.is_over) = (0, true);
        }
    }

    fn finish(&self) -> Result<(), String> {
        let count = self.count;
        match self.is_over {
            true => Ok(()),
            false => Err(format!("ends within the list, behind {count} entries")),
        }
    }

    fn error(&self, path: &Path, reason: String) -> ReadError {
        ReadError::malformed_at(path, Some(self.lines + 1), None, reason)
    }
}

#[cfg(test)]
mod tests {
    use serde_json::Value;

    use super::*;

    /// Values read from a table of numbers, the problems, and the result.
    fn read_numbers(text: &str, max_bytes: u64) -> (Vec<u64>, Vec<String>, Result<usize, String>) {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("table.json");
        std::fs::write(&path, text).unwrap();
        let shown = |error: &ReadError| error.to_string().replace(&*path.to_string_lossy(), "");
        let (mut problems, mut numbers) = (Vec::new(), Vec::new());
        let result = read(
            &path,
            max_bytes,
            &mut problems,
            |keys| keys.token != "other",
            |row| {
                numbers.push(row.required("n")?.count()?);
                Ok(())
            },
        );
        (
            numbers,
            problems.iter().map(shown).collect(),
            result.map_err(|error| shown(&error)),
        )
    }

    #[test]
    fn rows_of_a_table_are_taken_one_by_one() {
        let (numbers, problems, result) = read_numbers(
            r#"[{"n": 1}, {"n": "x", "token": "other"}, {"n": "7"}, {"m": 2}, 3]"#,
            100,
        );
        assert_eq!((numbers, result), (vec![1, 7], Ok(2)));
        assert_eq!(problems, [": 3.n: missing", ": 4: 3, expected a map"]);
        let many = format!("[{}]", vec!["{}"; 50].join(","));
        let (_, problems, result) = read_numbers(&many, 1000);
        assert_eq!((problems.len(), result), (21, Ok(0)));
        assert_eq!(
            problems[20],
            ": 50 entries cannot be used: left out; the first 20 are listed"
        );
    }

    #[test]
    fn a_row_that_is_no_json_costs_only_itself() {
        let (numbers, problems, result) =
            read_numbers(r#"[{"n": 1}, {"n": NaN}, , {"n": "a]\"b"}, {"n": 4}]"#, 100);
        assert_eq!((numbers, result), (vec![1, 4], Ok(2)));
        assert_eq!(problems.len(), 3);
        assert_eq!(
            problems[0],
            ": 1.n: the text \"NaN\", expected a whole number from 0"
        );
        assert!(
            problems[1].starts_with(": 2: no sound JSON: EOF"),
            "{problems:?}"
        );
    }

    #[test]
    fn a_truncated_table_gives_its_complete_rows() {
        let (numbers, problems, result) = read_numbers("[{\"n\": 1},\n {\"n\"", 100);
        assert_eq!((numbers, result), (vec![1], Ok(1)));
        assert_eq!(problems, [":2: ends within the list, behind 1 entries"]);
        assert_eq!(
            read_numbers("[{", 100).2.unwrap_err(),
            ":1: ends within the list, behind 0 entries"
        );
        assert_eq!(
            read_numbers("", 100).2.unwrap_err(),
            ":1: ends within the list, behind 0 entries"
        );
        assert_eq!(
            read_numbers("{}", 100).2.unwrap_err(),
            ":1: '{', expected a list"
        );
        assert_eq!(
            read_numbers("\n[{\"n\": 1}] x", 100).1,
            [":2: more follows the list"]
        );
        assert_eq!(read_numbers(" [ ] ", 100), (vec![], vec![], Ok(0)));
        assert_eq!(
            read_numbers("[1, 2]", 5).2.unwrap_err(),
            ": 6 bytes: larger than 5 bytes, the most that is read"
        );
    }

    #[test]
    fn entries_are_the_same_however_the_file_is_cut_into_reads() {
        let text = br#" [ {"a": [1, 2], "b": "],[\\\""} , 3,"x" ] "#;
        let whole = serde_json::from_slice::<Vec<Value>>(text).unwrap();
        for size in 1..text.len() {
            let (mut list, mut entries) = (RowSplitter::default(), Vec::new());
            for bytes in text.chunks(size) {
                list.push(bytes, &mut |_, raw| {
                    entries.push(serde_json::from_slice::<Value>(raw).unwrap())
                })
                .unwrap();
            }
            assert_eq!((list.finish(), &entries), (Ok(()), &whole));
        }
    }
}
