//! Layout of files on disk: its row in the table of layouts, and its reader.

use std::fmt;
use std::path::Path;

use serde::{Serialize, Serializer};

use super::problem::listed;
use crate::{Dataset, OpenOptions, ReadError, Result, Scenario};

/// A layout of files on disk: its row of the table.
#[derive(Clone, Copy)]
pub struct Layout(pub(crate) &'static LayoutRow);

/// Row of a layout, in the file of its reader.
#[derive(Debug)]
pub struct LayoutRow {
    /// Its name in files of results.
    pub(crate) key: &'static str,
    /// Its name in messages and tables.
    pub name: &'static str,
    /// The data sets that are published in it.
    pub data_sets: &'static str,
    /// The files that identify it, relative to a scenario's folder or the root of the data set.
    pub files: &'static str,
    /// Name of the evaluation protocol that is the default for it.
    pub(crate) protocol: &'static str,
    /// Its reader; `None`: that of the row before, which detects both.
    pub(crate) reader: Option<LayoutReader>,
}

/// Reader of one or several layouts.
#[derive(Debug)]
pub(crate) enum LayoutReader {
    /// Opens the data sets at or below a folder; `Ok(None)` where there are none.
    DataSet(fn(&Path, &OpenOptions) -> Result<Option<Dataset>>),
    /// True for the folder of a sequence of a single vehicle, and opens it; the caller gives it its name.
    Sequence(
        fn(&Path) -> bool,
        fn(&Path, &OpenOptions, &mut Vec<ReadError>) -> Result<Scenario>,
    ),
}

impl Layout {
    /// Its name in messages and tables.
    pub fn name(self) -> &'static str {
        self.0.name
    }
}

impl PartialEq for Layout {
    fn eq(&self, other: &Self) -> bool {
        self.0.key == other.0.key
    }
}

impl Eq for Layout {}

impl fmt::Debug for Layout {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.0.key)
    }
}

impl Serialize for Layout {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        serializer.serialize_str(self.0.key)
    }
}

/// The data set of some scenarios; `None` where there are neither these nor problems.
///
/// # Errors
/// The problems, if they left no scenario.
pub(super) fn opened(
    dir: &Path,
    scenarios: Vec<Scenario>,
    mut problems: Vec<ReadError>,
) -> Result<Option<Dataset>> {
    let layout = scenarios.first().map(|scenario| scenario.layout);
    match (layout, problems.len()) {
        (Some(layout), _) => Ok(Some(Dataset {
            layout,
            scenarios,
            problems,
        })),
        (None, 0) => Ok(None),
        (None, 1) => Err(problems.swap_remove(0)),
        (None, _) => {
            let reason = format!("nothing can be opened: {}", listed(&problems));
            Err(ReadError::malformed(dir, reason))
        }
    }
}
