//! KITTI's text files: rows of numbers, and calibrations of `NAME: numbers`.

use std::path::{Path, PathBuf};

use protocol::Pose;
use protocol::text::excerpt;

use super::faults::Faults;
use super::{ReadError, Result, files, poses};

/// Largest text file that is read, bytes: poses of a hundred thousand scans.
const MAX_BYTES: u64 = 32 << 20;

/// A calibration file.
#[derive(Debug)]
pub(super) struct Calibration {
    path: PathBuf,
    /// Name, line and the text after the name.
    entries: Vec<(String, u64, String)>,
}

/// The lines of a text file, with their numbers from 1, blank ones left out.
pub(super) fn lines(path: &Path) -> Result<Vec<(u64, String)>> {
    let mut lines = counted_lines(path)?;
    lines.retain(|(_, line)| !line.trim().is_empty());
    Ok(lines)
}

/// The lines of a text file whose values belong to lines, with their numbers from 1; blank ones at the end left out.
pub(super) fn counted_lines(path: &Path) -> Result<Vec<(u64, String)>> {
    let text = files::read_text(path, MAX_BYTES)?;
    let lines = text.trim_end().lines().map(str::to_owned);
    Ok((1..).zip(lines).collect())
}

/// One value per line; a line that cannot be read, or is blank, has none and is added to `faults`.
///
/// # Errors
/// [`ReadError`] for a comment too: lines are counted, and it is not known whether it counts.
pub(super) fn rows<T>(
    path: &Path,
    faults: &mut Faults,
    read: impl Fn(u64, &str) -> Result<T>,
) -> Result<Vec<Option<T>>> {
    let lines = counted_lines(path)?;
    let mut texts = lines.iter();
    if let Some((line, _)) = texts.find(|(_, text)| text.trim_start().starts_with('#')) {
        let reason = "a comment, where the number of a line is that of a scan".to_owned();
        return Err(malformed(path, *line, None, reason));
    }
    let values = lines.iter().map(|(line, text)| match text.trim() {
        "" => Err(malformed(path, *line, None, "the line is blank".to_owned())),
        _ => read(*line, text),
    });
    Ok(values.map(|value| faults.take(value)).collect())
}

pub(super) fn malformed(path: &Path, line: u64, field: Option<&str>, reason: String) -> ReadError {
    ReadError::malformed_at(path, Some(line), field, reason)
}

/// Exactly `N` finite numbers, separated by blanks.
pub(super) fn numbers<const N: usize>(
    path: &Path,
    line: u64,
    field: Option<&str>,
    text: &str,
) -> Result<[f64; N]> {
    let mut numbers = Vec::with_capacity(N);
    for word in text.split_ascii_whitespace() {
        let number = word.parse().ok().filter(|number: &f64| number.is_finite());
        numbers.push(number.ok_or_else(|| {
            let reason = format!("{:?} is no finite number", excerpt(word, 40));
            malformed(path, line, field, reason)
        })?);
    }
    let found = numbers.len();
    let reason = |_| malformed(path, line, field, format!("{found} numbers, expected {N}"));
    <[f64; N]>::try_from(numbers).map_err(reason)
}

/// A rigid transform from a row-major 3x4 matrix.
pub(super) fn rigid(path: &Path, line: u64, field: Option<&str>, rows: &[f64; 12]) -> Result<Pose> {
    poses::of_rows(rows).map_err(|error| malformed(path, line, field, error.to_string()))
}

impl Calibration {
    pub(super) fn read(path: &Path) -> Result<Self> {
        let entries = lines(path)?.into_iter().filter_map(|(number, line)| {
            let (name, values) = line.split_once(':')?;
            Some((name.trim().to_owned(), number, values.to_owned()))
        });
        Ok(Self {
            path: path.to_owned(),
            entries: entries.collect(),
        })
    }

    fn numbers<const N: usize>(&self, name: &str) -> Result<(u64, [f64; N])> {
        let entry = self.entries.iter().find(|(found, ..)| found == name);
        let missing = || ReadError::malformed_at(&self.path, None, Some(name), "missing");
        let (_, line, values) = entry.ok_or_else(missing)?;
        Ok((*line, numbers(&self.path, *line, Some(name), values)?))
    }

    /// A 3x4 transform.
    pub(super) fn transform(&self, name: &str) -> Result<Pose> {
        let (line, rows) = self.numbers::<12>(name)?;
        rigid(&self.path, line, Some(name), &rows)
    }

    /// A 3x3 rotation.
    pub(super) fn rotation(&self, name: &str) -> Result<Pose> {
        let (line, [a, b, c, d, e, f, g, h, i]) = self.numbers::<9>(name)?;
        // Row-major, with a translation of zero in every fourth place.
        let rows = [a, b, c, 0.0, d, e, f, 0.0, g, h, i, 0.0];
        rigid(&self.path, line, Some(name), &rows)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn calibrations_are_read_by_name() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("calib.txt");
        std::fs::write(
            &path,
            "P0: 1 2\n\nTr: 0 -1 0 1 0 0 -1 2 1 0 0 3\nR0_rect: 1 0 0 0 1 0 0 0 1\nBad: 1 0 0 0 1 0 0 0 x\n",
        )
        .unwrap();
        let calibration = Calibration::read(&path).unwrap();
        assert_eq!(
            calibration.transform("Tr").unwrap().translation_m,
            [1.0, 2.0, 3.0]
        );
        assert_eq!(calibration.rotation("R0_rect").unwrap(), Pose::IDENTITY);
        for (result, expected) in [
            (
                calibration.rotation("Bad"),
                ":5: Bad: \"x\" is no finite number",
            ),
            (
                calibration.transform("P0"),
                ":1: P0: 2 numbers, expected 12",
            ),
            (calibration.transform("Q"), ": Q: missing"),
        ] {
            let message = result.unwrap_err().to_string();
            assert_eq!(message.replace(&*path.to_string_lossy(), ""), expected);
        }
    }
}
