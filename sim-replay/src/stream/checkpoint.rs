//! Checkpoint of a replay in a file: a restarted replay resumes from there.

use std::io::ErrorKind;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::thread::{self, JoinHandle};

use serde::{Deserialize, Serialize};

use super::StreamReport;
use super::schedule::Position;
use bus::bounded_queue::{BoundedQueue, Pop};
use support::atomic_file;
use support::bounded_file;
use support::file_error::{AtFile, FileError};

/// Largest file that is read: a checkpoint is a few numbers.
const MAX_BYTES: u64 = 64 << 10;

/// State of a replay.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Place {
    /// The scenario.
    pub scenario: String,
    /// The options that give the order of ticks, as text: a replay resumes with the same.
    pub plan: String,
    /// True once the replay has ended and has left the run.
    pub has_ended: bool,
    /// Position in the scenario.
    pub position: Position,
    /// True if the clock is halted.
    pub is_halted: bool,
    /// Ticks published so far, by all process instances.
    pub ticks: u64,
    /// Ticks that were not answered, by all process instances.
    pub unanswered: u64,
    /// Frames that could not be read, by all process instances.
    pub unreadable_frames: u64,
}

impl Place {
    /// The state left by the previous process instance in a scenario of `ticks` ticks; `None` if there was none.
    ///
    /// # Errors
    /// [`FileError`] if the file holds no state, or that of another scene, of other options or of a replay that has
    /// ended.
    pub fn read(
        path: &Path,
        (scenario, ticks): (&str, usize),
        plan: &str,
    ) -> Result<Option<Self>, FileError> {
        let Some(place) = Self::load(path)? else {
            return Ok(None);
        };
        let (tick, of, planned) = (place.position.next_tick, &place.scenario, &place.plan);
        // A next tick equal to `ticks` is valid: the scene was played to its end.
        let problem = if of != scenario || tick > ticks {
            format!("tick {tick} of scenario {of}, but scenario {scenario} has {ticks} ticks")
        } else if place.has_ended {
            "of a replay that has ended".to_owned()
        } else if planned != plan {
            format!("of a replay with {planned}, and this one has {plan}")
        } else {
            return Ok(Some(place));
        };
        let problem = format!("the checkpoint is {problem}: remove the file, or choose another");
        Err(FileError::new(path, problem))
    }

    /// Notes in the file that the replay has ended: not before a crash needs no restart any more.
    ///
    /// # Errors
    /// [`FileError`] if it cannot be read or written. Without a file there is nothing to note.
    pub fn end(path: &Path) -> Result<(), FileError> {
        Self::load(path)?.map_or(Ok(()), |mut place| {
            place.has_ended = true;
            write(path, &place).at(path)
        })
    }

    fn load(path: &Path) -> Result<Option<Self>, FileError> {
        let text = match bounded_file::read_text(path, MAX_BYTES) {
            Ok(text) => text,
            Err(error) if error.kind() == ErrorKind::NotFound => return Ok(None),
            Err(error) => return Err(FileError::new(path, error)),
        };
        let read = serde_json::from_str(&text).map(Some);
        read.map_err(|error| FileError::new(path, format!("not a replay checkpoint: {error}")))
    }

    /// Report of the previous process instances.
    pub(super) fn report(&self) -> StreamReport {
        // The file may hold any number; counting continues from here.
        let [ticks, unanswered, unreadable_frames] =
            [self.ticks, self.unanswered, self.unreadable_frames]
                .map(|count| count.min(u64::MAX >> 1));
        StreamReport {
            ticks,
            unanswered,
            unreadable_frames,
            ..StreamReport::default()
        }
    }
}

/// Writes checkpoints on its own thread: the clock does not wait for the disk.
pub(super) struct Checkpoint {
    newest: Arc<BoundedQueue<(), Place>>,
    writing: Option<JoinHandle<()>>,
}

impl Checkpoint {
    /// # Errors
    /// If the system provides no thread.
    pub(super) fn open(path: PathBuf) -> std::io::Result<Self> {
        let newest = Arc::new(BoundedQueue::new(1, 1));
        let writing = thread::Builder::new().name("checkpoint".into()).spawn({
            let newest = Arc::clone(&newest);
            move || write_all(&path, &newest)
        })?;
        Ok(Self {
            newest,
            writing: Some(writing),
        })
    }

    /// Queues a state for writing; one that still waits for the disk is replaced.
    pub(super) fn note(&self, place: Place) {
        // A replaced place is no loss: only the newest counts.
        let _ = self.newest.push((), place);
    }
}

impl Drop for Checkpoint {
    fn drop(&mut self) {
        // The thread still writes the last place, since a closed queue gives out what it holds.
        self.newest.close();
        let writing = self.writing.take();
        if writing.is_some_and(|writing| writing.join().is_err()) {
            tracing::error!("the thread that writes checkpoints panicked");
        }
    }
}

fn write_all(path: &Path, places: &BoundedQueue<(), Place>) {
    let mut has_warned = false;
    while let Pop::Item((), place) = places.take(None) {
        match write(path, &place) {
            Ok(()) => has_warned = false,
            // Without a checkpoint the replay continues, but it cannot be resumed.
            Err(error) if !has_warned => {
                tracing::warn!(
                    "{}: {error}; a replay restarted now resumes from the last checkpoint written",
                    path.display()
                );
                has_warned = true;
            }
            Err(_) => {}
        }
    }
}

fn write(path: &Path, place: &Place) -> std::io::Result<()> {
    // A replay resumes after a crash of its own, never after a power cut: no tick waits for the disk.
    atomic_file::write_volatile(path, serde_json::to_string(place)? + "\n")
}

#[cfg(test)]
mod tests {
    use std::fs;

    use super::*;

    const PLAN: &str = "seek 0, frames 10, loop false";

    fn place() -> Place {
        Place {
            scenario: "town1".into(),
            plan: PLAN.into(),
            has_ended: false,
            position: Position {
                next_tick: 7,
                left: Some(3),
                shift_nanos: 5,
                last_nanos: Some(700),
            },
            is_halted: true,
            ticks: 7,
            unanswered: 1,
            unreadable_frames: 2,
        }
    }

    #[test]
    fn the_last_checkpoint_is_read_back() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("place.json");
        assert_eq!(Place::read(&path, ("town1", 10), PLAN).unwrap(), None);
        let checkpoint = Checkpoint::open(path.clone()).unwrap();
        for ticks in 0..=7 {
            checkpoint.note(Place { ticks, ..place() });
        }
        drop(checkpoint);
        let read = Place::read(&path, ("town1", 10), PLAN).unwrap();
        assert_eq!(read, Some(place()));
        assert_eq!(
            fs::read_dir(folder.path()).unwrap().count(),
            1,
            "nothing is left beside it"
        );
        let report = place().report();
        assert_eq!(
            (report.ticks, report.unanswered, report.unreadable_frames),
            (7, 1, 2)
        );
    }

    fn read_error(path: &Path, scenario: &str, ticks: usize) -> String {
        Place::read(path, (scenario, ticks), PLAN)
            .unwrap_err()
            .to_string()
    }

    #[test]
    fn a_replay_resumes_with_the_same_options_until_it_has_ended() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("place.json");
        Place::end(&path).unwrap();
        assert!(!path.exists(), "nothing was played");
        write(&path, &place()).unwrap();
        let other = "seek 5, frames all, loop true";
        let error = Place::read(&path, ("town1", 10), other).unwrap_err();
        let expected = format!(
            "{}: the checkpoint is of a replay with {PLAN}, and this one has {other}: remove the file, or choose another",
            path.display()
        );
        assert_eq!(error.to_string(), expected);
        Place::end(&path).unwrap();
        let error = read_error(&path, "town1", 10);
        assert!(
            error.contains("the checkpoint is of a replay that has ended: remove the file"),
            "{error}"
        );
    }

    #[test]
    fn a_checkpoint_of_another_scene_and_a_broken_one_are_reported() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("place.json");
        write(&path, &place()).unwrap();
        for (scenario, ticks) in [("town4", 10), ("town1", 6)] {
            let error = read_error(&path, scenario, ticks);
            assert!(
                error.contains("tick 7 of scenario town1") && error.contains(scenario),
                "{error}"
            );
        }
        for broken in ["{", "[]", "{\"scenario\": \"town1\"}"] {
            fs::write(&path, broken).unwrap();
            assert!(read_error(&path, "town1", 10).contains("not a replay checkpoint"));
        }
        fs::write(&path, " ".repeat(MAX_BYTES as usize + 1)).unwrap();
        assert!(read_error(&path, "town1", 10).contains("larger than"));
    }

    #[test]
    fn a_file_that_cannot_be_written_ends_nothing() {
        let checkpoint = Checkpoint::open(PathBuf::from("/nowhere/place.json")).unwrap();
        checkpoint.note(place());
        drop(checkpoint);
        assert!(
            Place::read(Path::new("/nowhere/place.json"), ("town1", 10), PLAN)
                .unwrap()
                .is_none()
        );
    }
}
