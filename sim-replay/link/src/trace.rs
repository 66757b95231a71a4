//! Link traces: measured rates, delays and losses over time.

use std::path::Path;

use protocol::text::excerpt;

use support::csv_file::{CsvFile, CsvRow};
use support::file_error::{AtFile, FileError};
use support::{bounded_file, rounding};

/// First line of a CSV trace.
const HEADER: &str = "time_s,bandwidth_mbps,latency_ms,loss";
/// Bytes of a mahimahi delivery opportunity.
pub(super) const OPPORTUNITY_BYTES: u64 = 1500;
/// Longer files are refused, bytes.
const MAX_FILE_BYTES: u64 = 256 << 20;
const NO_NUMBERS: &str = "no line with numbers";

/// The state of a link from a time on.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Step {
    /// Start of the step, nanoseconds since the beginning.
    pub from_nanos: u64,
    /// Rate, bit/s.
    pub bits_per_s: u64,
    /// Propagation delay, milliseconds.
    pub latency_ms: f64,
    /// Probability of loss.
    pub loss: f64,
}

/// A link over time.
#[derive(Debug, Clone, PartialEq)]
pub enum Trace {
    /// Rates, delays and losses; the last step has no end.
    Steps(Vec<Step>),
    /// Times at which 1,500 bytes may be sent, nanoseconds, in order; repeated after the last one.
    Opportunities(Vec<u64>),
}

impl Trace {
    /// Reads `time_s,bandwidth_mbps,latency_ms,loss`: one line for every change, times rising, the first at `offset_nanos` or
    /// before. The link begins at `offset_nanos`.
    ///
    /// # Errors
    /// [`FileError`] with the file and the line.
    pub fn read_csv(path: &Path, offset_nanos: u64) -> Result<Self, FileError> {
        let mut steps: Vec<Step> = Vec::new();
        for row in CsvFile::read(path, HEADER, MAX_FILE_BYTES)?.rows() {
            let row = row.complete()?;
            let step = step(&row)?;
            let is_later = match steps.last() {
                Some(last) => step.from_nanos > last.from_nanos,
                // The first step must cover the beginning of the link: before it there is no rate.
                None => step.from_nanos <= offset_nanos,
            };
            if !is_later {
                let must = "later than the line before, the first at offset_s (0) or before";
                return Err(row.wrong(0, must));
            }
            steps.push(step);
        }
        // The last step has no end, so any offset would do: one behind the last line counts as a mistake.
        let last = steps.last();
        if last.is_some_and(|last| last.from_nanos < offset_nanos) {
            let offset_s = offset_nanos as f64 * 1e-9;
            let problem = format_args!("offset_s is {offset_s}, behind the last line");
            return Err(FileError::new(path, problem));
        }
        // The step in force at the offset becomes the first one, and its start is clipped to 0 by the shift.
        let after = steps.partition_point(|step| step.from_nanos <= offset_nanos);
        let left = steps.get(after.saturating_sub(1)..).unwrap_or_default();
        if left.is_empty() {
            return Err(FileError::new(path, NO_NUMBERS));
        }
        let shifted = left.iter().map(|step| Step {
            from_nanos: step.from_nanos.saturating_sub(offset_nanos),
            ..*step
        });
        Ok(Self::Steps(shifted.collect()))
    }

    /// Reads delivery opportunities in mahimahi's format: one line per packet, whole milliseconds that never decrease.
    ///
    /// # Errors
    /// [`FileError`] with the file and the line.
    pub fn read_mahimahi(path: &Path) -> Result<Self, FileError> {
        let mut times = Vec::new();
        let text = bounded_file::read_text(path, MAX_FILE_BYTES).at(path)?;
        let lines = text.lines().enumerate();
        for (index, line) in lines.filter(|(_, line)| !line.trim().is_empty()) {
            let ms = line.trim().parse::<u64>().ok();
            match ms.and_then(|ms| ms.checked_mul(1_000_000)) {
                // Equal times are several packets in one millisecond.
                Some(time) if times.last().is_none_or(|&last| time >= last) => times.push(time),
                _ => {
                    let must = "whole milliseconds, not before the line above";
                    return Err(wrong(path, index, line, must));
                }
            }
        }
        match times.last() {
            None => Err(FileError::new(path, NO_NUMBERS)),
            // The length of a trace is its last time: one that ends at 0 would deliver everything at once.
            Some(0) => Err(wrong(path, times.len() - 1, "0", "a last line above 0")),
            Some(_) => Ok(Self::Opportunities(times)),
        }
    }

    /// The step at a time; `None` for opportunities.
    pub(super) fn at(&self, nanos: u64) -> Option<&Step> {
        match self {
            Self::Steps(steps) => {
                let after = steps.partition_point(|step| step.from_nanos <= nanos);
                steps.get(after.saturating_sub(1))
            }
            Self::Opportunities(_) => None,
        }
    }
}

fn step(row: &CsvRow<'_>) -> Result<Step, FileError> {
    let time_s = row.number(0, 0.0..=1e9, "0 to 1e9 seconds")?;
    let bandwidth_mbps = row.number(1, 0.0..=1e6, "0 to 1e6 Mbit/s")?;
    Ok(Step {
        from_nanos: rounding::to_u64(time_s * 1e9),
        bits_per_s: rounding::to_u64(bandwidth_mbps * 1e6),
        latency_ms: row.number(2, 0.0..=600_000.0, "0 to 600,000 ms")?,
        loss: row.number(3, 0.0..=1.0, "0 to 1")?,
    })
}

fn wrong(path: &Path, index: usize, found: &str, must: &str) -> FileError {
    let problem = format_args!("{:?} must be {must}", excerpt(found, 80));
    FileError::in_line(path, index as u64 + 1, problem)
}

#[cfg(test)]
mod tests {
    use std::path::PathBuf;

    use super::*;

    fn file(text: &str) -> (tempfile::TempDir, PathBuf) {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("trace.txt");
        std::fs::write(&path, text).unwrap();
        (folder, path)
    }

    #[test]
    fn steps_hold_until_the_next() {
        let (_folder, path) =
            file("time_s,bandwidth_mbps,latency_ms,loss\n0,27,10,0\n2.5,1.5,40,0.1\n\n");
        let trace = Trace::read_csv(&path, 0).unwrap();
        for (seconds, bits_per_s) in [
            (0.0, 27_000_000),
            (2.499, 27_000_000),
            (2.5, 1_500_000),
            (900.0, 1_500_000),
        ] {
            let step = trace.at((seconds * 1e9) as u64).unwrap();
            assert_eq!(step.bits_per_s, bits_per_s, "{seconds}");
        }
    }

    /// Start in seconds and rate of every step of a link that begins at `offset_s`.
    fn steps_from(path: &Path, offset_s: f64) -> Result<Vec<(f64, u64)>, String> {
        match Trace::read_csv(path, (offset_s * 1e9) as u64) {
            Ok(Trace::Steps(steps)) => Ok(steps
                .iter()
                .map(|step| (step.from_nanos as f64 * 1e-9, step.bits_per_s))
                .collect()),
            other => Err(other.unwrap_err().to_string()),
        }
    }

    #[test]
    fn a_link_begins_at_any_moment_of_its_trace() {
        let text = "time_s,bandwidth_mbps,latency_ms,loss\n10,27,10,0\n12.5,1.5,40,0.1\n20,6,5,0\n";
        let (_folder, path) = file(text);
        assert_eq!(
            steps_from(&path, 10.0).unwrap(),
            [(0.0, 27_000_000), (2.5, 1_500_000), (10.0, 6_000_000)]
        );
        assert_eq!(
            steps_from(&path, 13.0).unwrap(),
            [(0.0, 1_500_000), (7.0, 6_000_000)]
        );
        assert_eq!(steps_from(&path, 20.0).unwrap(), [(0.0, 6_000_000)]);
        assert!(
            steps_from(&path, 9.0).unwrap_err().contains("trace.txt:2:"),
            "it has not begun"
        );
        assert!(
            steps_from(&path, 20.5)
                .unwrap_err()
                .contains("offset_s is 20.5, behind the last line")
        );
    }

    #[test]
    fn faults_are_reported_with_their_line() {
        let header = "time_s,bandwidth_mbps,latency_ms,loss\n";
        for (text, line) in [
            ("1,2,3,0\n", 2),
            ("0,2,3,0\n0,2,3,0\n", 3),
            ("0,2,3,0\n5,2,3,0\n4.9,2,3,0\n", 4),
            ("0,2,3\n", 2),
            ("0,-1,0,0\n", 2),
            ("0,1,0,nan\n", 2),
        ] {
            let (_folder, path) = file(&format!("{header}{text}"));
            let message = Trace::read_csv(&path, 0).unwrap_err().to_string();
            assert!(message.contains(&format!("trace.txt:{line}:")), "{message}");
        }
        assert!(Trace::read_csv(Path::new("no/such/trace.csv"), 0).is_err());
        let (_folder, path) = file("time,rate\n");
        assert!(
            Trace::read_csv(&path, 0)
                .unwrap_err()
                .to_string()
                .contains("header")
        );
        let (_folder, path) = file("2\n5\n3\n");
        let message = Trace::read_mahimahi(&path).unwrap_err().to_string();
        assert!(
            message.contains("trace.txt:3: \"3\"") && message.contains("not before the line above"),
            "{message}"
        );
        for text in ["x\n", "-1\n", "0\n0\n", ""] {
            let (_folder, path) = file(text);
            assert!(Trace::read_mahimahi(&path).is_err(), "{text:?}");
        }
    }
}
