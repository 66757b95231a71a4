//! How far a replay is, in a file: one that falls is started again and goes on from there.

use std::fs;
use std::io::ErrorKind;
use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};

use super::StreamReport;
use super::schedule::Position;

/// Largest file that is read: a place has a few numbers.
const LARGEST: u64 = 64 << 10;

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
    /// What earlier lives have to report.
    pub(super) fn report(&self) -> StreamReport {
        let Self { ticks, unanswered, unreadable_frames, .. } = *self;
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

/// The file.
#[derive(Debug)]
pub(super) struct Bookmark {
    path: PathBuf,
    /// It is said once that the file cannot be written.
    is_broken: bool,
}

impl Bookmark {
    pub(super) fn new(path: PathBuf) -> Self {
        Self { path, is_broken: false }
    }

    /// The place that an earlier life has left in a scenario of `ticks` ticks; `None`: there was no earlier life.
    pub(super) fn read(&self, scenario: &str, ticks: usize) -> Result<Option<Place>, BookmarkError> {
        let path = || self.path.clone();
        let text = match text_of(&self.path) {
            Ok(text) => text,
            Err(error) if error.kind() == ErrorKind::NotFound => return Ok(None),
            Err(source) => return Err(BookmarkError::Read { path: path(), source }),
        };
        let place: Place =
            serde_json::from_str(&text).map_err(|source| BookmarkError::Text { path: path(), source })?;
        if place.scenario != scenario || place.position.next_tick > ticks {
            let told = format!("is tick {} of scenario {}", place.position.next_tick, place.scenario);
            return Err(BookmarkError::Elsewhere { path: path(), place: told, scenario: scenario.into(), ticks });
        }
        Ok(Some(place))
    }

    /// Writes a place down, whole or not at all. Without it the replay goes on; only a next life cannot.
    pub(super) fn write(&mut self, place: &Place) {
        let beside = self.path.with_extension("new");
        let text = serde_json::to_string(place).map_err(std::io::Error::from);
        let written =
            text.and_then(|text| fs::write(&beside, text + "\n")).and_then(|()| fs::rename(&beside, &self.path));
        match written {
            Ok(()) => self.is_broken = false,
            Err(error) if !self.is_broken => {
                tracing::warn!(
                    "{}: {error}; a replay that falls now begins where this file stands",
                    self.path.display()
                );
                self.is_broken = true;
            }
            Err(_) => {}
        }
    }
}

fn text_of(path: &Path) -> std::io::Result<String> {
    let length = fs::metadata(path)?.len();
    if length > LARGEST {
        let told = format!("{length} bytes, and at most {LARGEST} are read");
        return Err(std::io::Error::new(ErrorKind::InvalidData, told));
    }
    fs::read_to_string(path)
}

#[cfg(test)]
mod tests {
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
    fn a_place_comes_back() {
        let folder = tempfile::tempdir().unwrap();
        let mut bookmark = Bookmark::new(folder.path().join("place.json"));
        assert_eq!(bookmark.read("town1", 10).unwrap(), None);
        bookmark.write(&place());
        assert_eq!(bookmark.read("town1", 10).unwrap(), Some(place()));
        assert_eq!(fs::read_dir(folder.path()).unwrap().count(), 1, "nothing is left beside it");
        let report = place().report();
        assert_eq!((report.ticks, report.unanswered, report.unreadable_frames), (7, 1, 2));
    }

    #[test]
    fn a_place_of_another_scene_and_a_broken_one_are_named() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("place.json");
        let mut bookmark = Bookmark::new(path.clone());
        bookmark.write(&place());
        let told = |found: Result<Option<Place>, BookmarkError>| found.unwrap_err().to_string();
        for (scenario, ticks) in [("town4", 10), ("town1", 6)] {
            let error = told(bookmark.read(scenario, ticks));
            assert!(error.contains("tick 7 of scenario town1") && error.contains(scenario), "{error}");
        }
        for broken in ["{", "[]", "{\"scenario\": \"town1\"}"] {
            fs::write(&path, broken).unwrap();
            assert!(told(bookmark.read("town1", 10)).contains("not the place of a replay"));
        }
        fs::write(&path, " ".repeat(LARGEST as usize + 1)).unwrap();
        assert!(told(bookmark.read("town1", 10)).contains("at most"));
    }

    #[test]
    fn a_file_that_cannot_be_written_ends_nothing() {
        let mut bookmark = Bookmark::new(PathBuf::from("/nowhere/place.json"));
        bookmark.write(&place());
        assert!(bookmark.is_broken);
    }
}
