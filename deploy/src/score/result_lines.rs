//! `detections.jsonl`, `tracks.jsonl` and `truth.jsonl`: a line per result or tick, appended during the run.

use std::fs::File;
use std::io::{self, BufWriter, Write};
use std::path::Path;

use serde::{Deserialize, Serialize};

/// A line, with the scenario that it is of where there are several.
#[derive(Debug, Serialize, Deserialize)]
pub struct ScenarioLine<S, T> {
    /// Name of the scenario.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub scenario: Option<S>,
    /// The result or tick.
    #[serde(flatten)]
    pub line: T,
}

/// Size of the buffer that waits for a full disk, bytes: some hundred lines.
const WAITING: usize = 1 << 20;

/// The file. A full disk ends no run: lines without room are counted.
pub(super) struct ResultLines<W: Write = File> {
    /// File name.
    name: String,
    out: BufWriter<W>,
    /// Lines since the last complete flush.
    waiting: u64,
    lost: u64,
    has_complained: bool,
}

impl ResultLines {
    pub(super) fn create(path: &Path) -> io::Result<Self> {
        let name = path.file_name().unwrap_or_default().to_string_lossy();
        File::create(path).map(|file| Self::over(name.into_owned(), file))
    }
}

impl<W: Write> ResultLines<W> {
    fn over(name: String, out: W) -> Self {
        Self {
            name,
            out: BufWriter::with_capacity(WAITING, out),
            waiting: 0,
            lost: 0,
            has_complained: false,
        }
    }

    /// Adds a line; another process may be reading the file.
    pub(super) fn add(&mut self, value: &impl Serialize) {
        // Numbers, names and lists have a spelling in JSON.
        let line = serde_json::to_string(value).unwrap_or_default() + "\n";
        // All or nothing: a line that does not fit into the buffer is not begun.
        let has_room = self.out.buffer().len() + line.len() <= WAITING || self.out.flush().is_ok();
        match has_room.then(|| self.out.write_all(line.as_bytes())) {
            Some(Ok(())) => self.waiting += 1,
            Some(Err(_)) | None => self.lost += 1,
        }
        match self.out.flush() {
            Ok(()) => (self.waiting, self.has_complained) = (0, false),
            Err(error) if !self.has_complained => {
                self.has_complained = true;
                tracing::error!("{} waits: {error}", self.name);
            }
            Err(_) => {}
        }
    }

    /// Number of lines that are not in the file.
    pub(super) fn finish(mut self) -> u64 {
        let is_written = self.out.flush().is_ok();
        // The rest of the buffer is not tried once more.
        let _ = self.out.into_parts();
        self.lost + if is_written { 0 } else { self.waiting }
    }
}

#[cfg(test)]
mod tests {
    use std::sync::{Arc, Mutex};

    use protocol::{CavId, Detections, DetectionsReport, Pose, PoseEstimate, Stamp};

    use super::*;

    /// A disk with room for so many bytes, and its content.
    #[derive(Clone, Default)]
    struct Disk(Arc<Mutex<(usize, Vec<u8>)>>);

    impl Disk {
        fn make_room(&self, bytes: usize) {
            self.0.lock().unwrap().0 = bytes;
        }

        fn lines(&self) -> Vec<serde_json::Value> {
            let text = String::from_utf8(self.0.lock().unwrap().1.clone()).unwrap();
            text.lines()
                .map(|line| serde_json::from_str(line).unwrap())
                .collect()
        }
    }

    impl Write for Disk {
        fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
            let (room, written) = &mut *self.0.lock().unwrap();
            let count = bytes.len().min(*room);
            *room -= count;
            written.extend_from_slice(&bytes[..count]);
            if count == 0 {
                Err(io::ErrorKind::StorageFull.into())
            } else {
                Ok(count)
            }
        }

        fn flush(&mut self) -> io::Result<()> {
            Ok(())
        }
    }

    fn report(tick: u64) -> DetectionsReport {
        let ego = CavId::new("e").unwrap();
        let stamp = Stamp {
            cav: ego.clone(),
            epoch: 1,
            sequence: tick,
            capture_nanos: tick,
            publish_nanos: tick,
        };
        let result = Detections {
            ego,
            agent_frame: tick,
            method: "max".into(),
            pose: PoseEstimate::new(Pose::IDENTITY, 1.0),
            detections: vec![],
            fused: vec![],
            skipped: vec![],
            neighbours: vec![],
            stages: vec![],
        };
        DetectionsReport::new(&stamp, Some(tick), result)
    }

    #[test]
    fn what_waits_for_a_full_disk_is_written_whole_when_there_is_room_again() {
        let disk = Disk::default();
        let mut lines = ResultLines::over("test.jsonl".into(), disk.clone());
        disk.make_room(report(0).to_json().len() + 7);
        (0..5).for_each(|tick| lines.add(&report(tick)));
        disk.make_room(1 << 30);
        lines.add(&report(5));
        assert_eq!((lines.finish(), disk.lines().len()), (0, 6));
    }

    #[test]
    fn what_finds_no_room_is_counted() {
        let disk = Disk::default();
        let mut lines = ResultLines::over("test.jsonl".into(), disk.clone());
        let fitting = WAITING / (report(10).to_json().len() + 1);
        (0..fitting + 30).for_each(|tick| lines.add(&report(10 + tick as u64 % 10)));
        assert_eq!((lines.lost, lines.waiting as usize), (30, fitting));
        disk.make_room(1 << 30);
        lines.add(&report(99));
        assert_eq!(lines.finish(), 30);
        let written = disk.lines();
        assert_eq!(
            (written.len(), &written[fitting]["tick"]),
            (fitting + 1, &99.into())
        );

        let full = Disk::default();
        let mut lines = ResultLines::over("test.jsonl".into(), full.clone());
        (0..3).for_each(|tick| lines.add(&report(tick)));
        assert_eq!((lines.finish(), full.lines().len()), (3, 0));
    }
}
