//! Marker files of folders whose writing was interrupted.

use std::path::{Path, PathBuf};

use super::{Dataset, ReadError};

/// Name of the file that marks a folder while a data set is written into it. Opening such a folder reports a problem.
pub const UNFINISHED: &str = ".unfinished";

/// Adds a problem for each marker in the opened folder and in those of its scenarios.
pub(super) fn report(dir: &Path, dataset: &mut Dataset) {
    let scenarios = dataset
        .scenarios
        .iter()
        .map(|scenario| dir.join(&scenario.name).join(UNFINISHED));
    let marks: Vec<PathBuf> = std::iter::once(dir.join(UNFINISHED))
        .chain(scenarios)
        .filter(|mark| mark.is_file())
        .collect();
    dataset.problems.extend(marks.into_iter().map(|mark| {
        let reason = "the run that wrote this folder did not end: frames may be missing or cut off";
        ReadError::malformed(&mark, reason)
    }));
}
