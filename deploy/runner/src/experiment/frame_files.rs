//! Frame files of an evaluation: detections, ground truth, a row per frame, and precision over recall.

use std::collections::BTreeMap;
use std::fs;
use std::io::ErrorKind;
use std::path::Path;

use anyhow::{Context, Result};

use deploy::operate::run_folder::frames_csv;
use deploy::score::FrameScores;
use deploy::score::metrics::{self, Metrics};
use fusion::Method;
use support::atomic_file;
use support::cli::{BadInput, NotWritten};
use support::file_error::check_folder;

use crate::experiment::cell::file_name;
use crate::frame_lines::FrameLines;

/// Begins the files of one method in a folder of its own in `out`: `detections.jsonl`, `tracks.jsonl` and `truth.jsonl`,
/// those of a run, with the name of the scenario. [`finish`] adds `frames.csv` and `precision_recall.csv`, and
/// [`write_metrics`], at the end, `metrics.json`.
///
/// # Errors
/// An error when there are such files already, or they cannot be written.
pub(crate) fn create(out: &Path, method: Method) -> Result<FrameLines> {
    check_folder(out).map_err(|error| BadInput::new(format!("--out {error}")))?;
    let folder = out.join(file_name(method));
    atomic_file::create_folder(out)
        .and_then(|()| fs::create_dir(&folder))
        .and_then(|()| atomic_file::sync_name(&folder))
        .and_then(|()| FrameLines::create(&folder))
        .map_err(|error| match error.kind() {
            // One that exists is the user's choice, any other is not.
            ErrorKind::AlreadyExists => {
                anyhow::Error::from(error).context(folder.display().to_string())
            }
            _ => anyhow::Error::from(error).context(NotWritten(folder.clone())),
        })
}

/// Writes the rest, with the scores of the same frames and the scenario of each of their records.
///
/// # Errors
/// An error with the first error of the operating system.
pub(crate) fn finish(lines: FrameLines, scores: &FrameScores, scenarios: &[String]) -> Result<()> {
    let folder = lines.folder.clone();
    let frames = frames_csv(scores.records(), &BTreeMap::new(), Some(scenarios));
    let curve = scores.precision_recall_csv();
    lines
        .finish()
        .and_then(|()| atomic_file::write(&folder.join("frames.csv"), frames))
        .and_then(|()| atomic_file::write(&folder.join("precision_recall.csv"), curve))
        .with_context(|| folder.display().to_string())
}

/// Writes `metrics.json` into the folder of a method in `out`.
///
/// # Errors
/// An error with the error of the operating system.
pub(crate) fn write_metrics(out: &Path, method: Method, metrics: &Metrics) -> Result<()> {
    let folder = out.join(file_name(method));
    let text = serde_json::to_string_pretty(metrics)?;
    atomic_file::write(&folder.join(metrics::FILE), text)
        .with_context(|| folder.display().to_string())
}
