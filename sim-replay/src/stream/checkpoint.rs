//! How far a replay is, in a file: one that falls is started again and goes on from there.

use std::io::ErrorKind;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::thread::{self, JoinHandle};

use serde::{Deserialize, Serialize};

use super::StreamReport;
use super::schedule::Position;
use bus::bounded_queue::{BoundedQueue, Pop, PushOutcome};
use support::atomic_file;
use support::bounded_file;

/// Largest file that is read: a place has a few numbers.
const MAX_BYTES: u64 = 64 << 10;

/// How far a replay is.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Place {
    /// The scenario.
    pub scenario: String,
    /// Where in it.
    pub position: Position,
    /// Whether the clock is halted.
    pub is_halted: bool,
    /// Ticks published so far, by all lives.
    pub ticks: u64,
    /// Ticks that were not answered, by all lives.
    pub unanswered: u64,
    /// Frames that could not be read, by all lives.
    pub unreadable_frames: u64,
}

impl Place {
    /// The place that an earlier life has left in a scenario of `ticks` ticks; `None`: there was no earlier life.
    ///
    /// # Errors
    /// [`BookmarkError`] when the file is no place, or one of another scene.
    pub fn read(path: &Path, scenario: &str, ticks: usize) -> Result<Option<Self>, BookmarkError> {
        let at = || path.to_path_buf();
        let text = match bounded_file::read_text(path, MAX_BYTES) {
            Ok(text) => text,
            Err(error) if error.kind() == ErrorKind::NotFound => return Ok(None),
            Err(source) => return Err(BookmarkError::Read { path: at(), source }),
        };
        let place: Self = serde_json::from_str(&text).map_err(|source| BookmarkError::Text { path: at(), source })?;
        if place.scenario != scenario || place.position.next_tick > ticks {
            let told = format!("is tick {} of scenario {}", place.position.next_tick, place.scenario);
            return Err(BookmarkError::Elsewhere { path: at(), place: told, scenario: scenario.into(), ticks });
        }
        Ok(Some(place))
    }

    /// What earlier lives have to report.
    pub(super) fn report(&self) -> StreamReport {
        // A file may say anything; counting goes on from here.
        let [ticks, unanswered, unreadable_frames] =
            [self.ticks, self.unanswered, self.unreadable_frames].map(|count| count.min(u64::MAX >> 1));
        StreamReport { ticks, unanswered, unreadable_frames, ..StreamReport::default() }
    }
}

/// Why a place cannot be read.
#[derive(Debug, thiserror::Error)]
pub enum BookmarkError {
    /// The file cannot be read.
    #[error("{}: {source}", path.display())]
    Read {
        /// Which.
        path: PathBuf,
        /// Why.
        source: std::io::Error,
    },
    /// It is none.
    #[error("{}: not the place of a replay: {source}", path.display())]
    Text {
        /// Which.
        path: PathBuf,
        /// Why.
        source: serde_json::Error,
    },
    /// It is one of another scene.
    #[error("{}: the place {place}, but scenario {scenario} has {ticks} ticks: remove the file, or choose another", path.display())]
    Elsewhere {
        /// Which.
        path: PathBuf,
        /// The place it tells.
        place: String,
        /// The scenario that is played.
        scenario: String,
        /// Its ticks.
        ticks: usize,
    },
}

/// Writes places down, on a thread of its own: the clock does not wait for a disk.
pub(super) struct Checkpoint {
    newest: Arc<BoundedQueue<(), Place>>,
    writing: Option<JoinHandle<()>>,
}

impl Checkpoint {
    /// # Errors
    /// When the system gives no thread.
    pub(super) fn open(path: PathBuf) -> std::io::Result<Self> {
        let newest = Arc::new(BoundedQueue::new(1, 1));
        let writing = thread::Builder::new().name("bookmark".into()).spawn({
            let newest = Arc::clone(&newest);
            move || write_all(&path, &newest)
        })?;
        Ok(Self { newest, writing: Some(writing) })
    }

    /// Has a place written down; one that still waits for the disk is out of date.
    pub(super) fn note(&self, place: Place) {
        match self.newest.push((), place) {
            PushOutcome::Queued | PushOutcome::Replaced(_) | PushOutcome::NoLane(_) | PushOutcome::Closed(_) => {}
        }
    }
}

impl Drop for Checkpoint {
    fn drop(&mut self) {
        self.newest.close();
        if self.writing.take().is_some_and(|writing| writing.join().is_err()) {
            tracing::error!("the thread that notes the place panicked");
        }
    }
}

fn write_all(path: &Path, places: &BoundedQueue<(), Place>) {
    let mut has_complained = false;
    while let Pop::Item((), place) = places.take(None) {
        match write(path, &place) {
            Ok(()) => has_complained = false,
            // Without it the replay goes on; only a next life cannot.
            Err(error) if !has_complained => {
                tracing::warn!("{}: {error}; a replay that falls now begins where this file stands", path.display());
                has_complained = true;
            }
            Err(_) => {}
        }
    }
}

fn write(path: &Path, place: &Place) -> std::io::Result<()> {
    atomic_file::write(path, serde_json::to_string(place)? + "\n")
}

#[cfg(test)]
mod tests {
    use std::fs;

    use super::*;

    fn place() -> Place {
        Place {
            scenario: "town1".into(),
            position: Position { next_tick: 7, left: Some(3), shift_nanos: 5, last_nanos: Some(700) },
            is_halted: true,
            ticks: 7,
            unanswered: 1,
            unreadable_frames: 2,
        }
    }

    #[test]
    fn the_last_place_comes_back() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("place.json");
        assert_eq!(Place::read(&path, "town1", 10).unwrap(), None);
        let bookmark = Checkpoint::open(path.clone()).unwrap();
        for ticks in 0..=7 {
            bookmark.note(Place { ticks, ..place() });
        }
        drop(bookmark);
        assert_eq!(Place::read(&path, "town1", 10).unwrap(), Some(place()));
        assert_eq!(fs::read_dir(folder.path()).unwrap().count(), 1, "nothing is left beside it");
        let report = place().report();
        assert_eq!((report.ticks, report.unanswered, report.unreadable_frames), (7, 1, 2));
    }

    #[test]
    fn a_place_of_another_scene_and_a_broken_one_are_named() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("place.json");
        write(&path, &place()).unwrap();
        let told = |found: Result<Option<Place>, BookmarkError>| found.unwrap_err().to_string();
        for (scenario, ticks) in [("town4", 10), ("town1", 6)] {
            let error = told(Place::read(&path, scenario, ticks));
            assert!(error.contains("tick 7 of scenario town1") && error.contains(scenario), "{error}");
        }
        for broken in ["{", "[]", "{\"scenario\": \"town1\"}"] {
            fs::write(&path, broken).unwrap();
            assert!(told(Place::read(&path, "town1", 10)).contains("not the place of a replay"));
        }
        fs::write(&path, " ".repeat(MAX_BYTES as usize + 1)).unwrap();
        assert!(told(Place::read(&path, "town1", 10)).contains("larger than"));
    }

    #[test]
    fn a_file_that_cannot_be_written_ends_nothing() {
        let bookmark = Checkpoint::open(PathBuf::from("/nowhere/place.json")).unwrap();
        bookmark.note(place());
        drop(bookmark);
        assert!(Place::read(Path::new("/nowhere/place.json"), "town1", 10).unwrap().is_none());
    }
}
