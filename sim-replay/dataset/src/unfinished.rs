//! Marker files of folders whose writing was interrupted.

use std::path::Path;

use super::{Dataset, ReadError};

/// Name of the file that marks a folder while a data set is written into it. Opening such a folder reports a problem.
pub const UNFINISHED: &str = ".unfinished";

/// Adds a problem for each marker in the opened folder and in those of its scenarios.
pub(super) fn report(dir: &Path, dataset: &mut Dataset) {
    let names = dataset.scenarios.iter().map(|one| one.name.as_str());
    // No name: the opened folder itself.
    for name in std::iter::once("").chain(names) {
        let mark = dir.join(name).join(UNFINISHED);
        if mark.is_file() {
            let reason =
                "the run that wrote this folder did not end: frames may be missing or cut off";
            dataset.problems.push(ReadError::malformed(&mark, reason));
        }
    }
}
