//! Sweep log: the arrival of each sweep at an agent, the one time from capture to detections that no message carries.
//!
//! One line per sweep: its capture time on the scene's clock and its arrival on the Unix clock, both in nanoseconds.

use std::collections::BTreeMap;
use std::fs::{File, OpenOptions};
use std::io::{self, BufRead, BufReader, Read, Write};
use std::path::Path;

/// Largest part of a file that is read, bytes: at 10 Hz this is two weeks.
const MOST_BYTES: u64 = 512 << 20;

/// Writer of a sweep log.
#[derive(Debug)]
pub struct SweepLog(File);

impl SweepLog {
    /// Opens the file to append to it.
    ///
    /// # Errors
    /// The system's, if the file cannot be written.
    pub fn open(path: &Path) -> io::Result<Self> {
        let file = OpenOptions::new().create(true).append(true).open(path);
        file.map(Self)
    }

    /// Appends a sweep.
    ///
    /// # Errors
    /// The system's, if the file cannot be written.
    pub fn note(&mut self, capture_nanos: u64, arrived_nanos: u64) -> io::Result<()> {
        // One write for each line, so that a killed process truncates the last one at most.
        self.0
            .write_all(format!("{capture_nanos},{arrived_nanos}\n").as_bytes())
    }
}

/// Arrival of every sweep in the file, by capture time. Invalid lines, for example a truncated one, are left out.
///
/// # Errors
/// The system's, if the file cannot be read.
pub fn read(path: &Path) -> io::Result<BTreeMap<u64, u64>> {
    let mut arrived = BTreeMap::new();
    for line in BufReader::new(crate::bounded_file::open(path)?.take(MOST_BYTES)).split(b'\n') {
        let line = line?;
        let numbers = String::from_utf8_lossy(&line)
            .split_once(',')
            .map(|(at, came)| (at.parse::<u64>(), came.parse::<u64>()));
        if let Some((Ok(at), Ok(came))) = numbers {
            arrived.insert(at, came);
        }
    }
    Ok(arrived)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_log_is_continued_and_read_without_invalid_lines() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("sweeps.csv");
        assert!(read(&path).is_err());
        SweepLog::open(&path)
            .unwrap()
            .note(100, 1_700_000_000_000_000_000)
            .unwrap();
        let mut log = SweepLog::open(&path).unwrap();
        log.0.write_all(b"\xff,150\n").unwrap();
        log.note(200, 1_700_000_000_100_000_000).unwrap();
        log.0.write_all(b"300,").unwrap();
        let expected = BTreeMap::from([
            (100, 1_700_000_000_000_000_000),
            (200, 1_700_000_000_100_000_000),
        ]);
        assert_eq!(read(&path).unwrap(), expected);
    }
}
