//! When each sweep reached an agent: the one moment on the way from capture to detections of which no message tells.
//!
//! One line per sweep: its capture time on the scene's clock and its arrival on the Unix clock, both in nanoseconds.

use std::collections::BTreeMap;
use std::fs::{File, OpenOptions};
use std::io::{self, BufRead, BufReader, Read, Write};
use std::path::Path;

/// Longer files are read no further: at 10 Hz this is two weeks.
const MOST_BYTES: u64 = 512 << 20;

/// The file as an agent writes it.
#[derive(Debug)]
pub struct SweepLog(File);

impl SweepLog {
    /// Opens the file, to go on at its end.
    ///
    /// # Errors
    /// When it cannot be written.
    pub fn open(path: &Path) -> io::Result<Self> {
        OpenOptions::new().create(true).append(true).open(path).map(Self)
    }

    /// Notes a sweep.
    ///
    /// # Errors
    /// When the file cannot be written.
    pub fn note(&mut self, capture_nanos: u64, arrived_nanos: u64) -> io::Result<()> {
        self.0.write_all(format!("{capture_nanos},{arrived_nanos}\n").as_bytes())
    }
}

/// Arrival of every sweep in the file, by capture time. What is no such line, for example one that was cut, is left out.
///
/// # Errors
/// When the file cannot be read.
pub fn read(path: &Path) -> io::Result<BTreeMap<u64, u64>> {
    let mut arrived = BTreeMap::new();
    for line in BufReader::new(File::open(path)?.take(MOST_BYTES)).lines() {
        let line = line?;
        let numbers = line.split_once(',').map(|(at, came)| (at.parse::<u64>(), came.parse::<u64>()));
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
    fn a_log_is_continued_and_read_without_what_was_cut() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("sweeps.csv");
        assert!(read(&path).is_err());
        SweepLog::open(&path).unwrap().note(100, 1_700_000_000_000_000_000).unwrap();
        let mut log = SweepLog::open(&path).unwrap();
        log.note(200, 1_700_000_000_100_000_000).unwrap();
        log.0.write_all(b"300,").unwrap();
        let expected = BTreeMap::from([(100, 1_700_000_000_000_000_000), (200, 1_700_000_000_100_000_000)]);
        assert_eq!(read(&path).unwrap(), expected);
    }
}
