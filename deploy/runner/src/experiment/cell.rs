//! Cells: results of evaluations, cached on disk by everything that they were made of. Sweeps and tables print them.

use std::collections::BTreeSet;
use std::io;
use std::ops::RangeInclusive;
use std::path::{Path, PathBuf};

use anyhow::{Context, Result};
use deploy::score::metrics::{ByIou, Messages, Metrics};
use fusion::Method;
use serde::{Deserialize, Serialize};
use support::atomic_file;
use support::bounded_file::{self, MAX_TEXT_BYTES};
use support::output;
use support::provenance::Provenance;

/// Digits of the key in the name of a file.
const NAME_DIGITS: usize = 24;
/// Average precisions, with room for the rounding of a sum of shares.
const PRECISIONS: RangeInclusive<f64> = -1e-6..=1.0 + 1e-6;

/// Identity of a result.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct CellKey {
    /// Fusion method.
    pub method: Method,
    /// SHA-256 over the settings, the programs, the data and all other files.
    pub sha256: String,
    /// Everything besides the settings.
    pub provenance: Provenance,
}

/// A completed evaluation.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Cell {
    /// Identity.
    pub key: CellKey,
    /// Metrics.
    pub metrics: Metrics,
    /// Number of neighbours' messages that were fused, over all frames.
    pub used: u64,
    /// Counts of the messages that are fused: feature maps, boxes or points, without the pose messages.
    pub messages: Messages,
    /// Compute time, seconds: for estimates, never for results.
    pub wall_seconds: f64,
}

impl CellKey {
    /// Cache file of the cell.
    fn file(&self, folder: &Path) -> PathBuf {
        // 24 of 64 hex digits name the file. The whole key is compared after reading.
        let digits: String = self.sha256.chars().take(NAME_DIGITS).collect();
        folder.join(format!("{}-{digits}.json", file_name(self.method)))
    }
}

impl Cell {
    /// The cached cell; `None` if it does not exist. A file that is no cell is named and counts as missing.
    ///
    /// # Errors
    /// An error when the file cannot be read.
    pub fn read(key: &CellKey, folder: &Path) -> Result<Option<Self>> {
        let path = key.file(folder);
        let text = match bounded_file::read_text(&path, MAX_TEXT_BYTES) {
            Ok(text) => text,
            Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(None),
            // Bytes that are no text are no cell.
            Err(error) if error.kind() == io::ErrorKind::InvalidData => String::new(),
            Err(error) => return Err(error).with_context(|| path.display().to_string()),
        };
        let cell = serde_json::from_str(&text)
            .ok()
            .filter(Self::has_precisions);
        if cell.is_none() {
            let path = path.display();
            output::note(format_args!("{path}: malformed, counts as missing"));
        }
        // Another key with the same first digits is no hit.
        Ok(cell.filter(|cell| cell.key.sha256 == key.sha256))
    }

    /// False where a precision is outside 0 to 1.
    fn has_precisions(&self) -> bool {
        let orders = [self.metrics.ap_global, self.metrics.ap_frame_order];
        let mut all = orders.iter().flat_map(ByIou::values).flatten();
        all.all(|precision| PRECISIONS.contains(&precision))
    }

    /// Caches the cell; the file appears only when it is complete.
    ///
    /// # Errors
    /// An error when it cannot be written.
    pub fn write(&self, folder: &Path) -> Result<()> {
        let path = self.key.file(folder);
        let text = serde_json::to_string_pretty(self)?;
        atomic_file::write(&path, text).with_context(|| path.display().to_string())
    }
}

/// Programs, data and all other files that cells were made of, a line each.
pub(super) fn sources<'c>(cells: impl Iterator<Item = &'c Cell>) -> BTreeSet<String> {
    let mut lines = BTreeSet::new();
    for Cell { key, .. } in cells {
        let of = &key.provenance;
        let (version, commit, sha256) = (&of.version, &of.commit, &of.program_sha256);
        lines.insert(format!(
            "program {version}, commit {commit}, SHA-256 {sha256}"
        ));
        lines.insert(format!("data SHA-256 {}", of.data_sha256));
        for (file, sha256) in &of.files_sha256 {
            lines.insert(format!("{} SHA-256 {sha256}", file.display()));
        }
    }
    lines
}

/// Name of a method as a name of files: that of a TorchScript file has its path in it.
pub(crate) fn file_name(method: Method) -> String {
    method.name().replace(
        |letter: char| !letter.is_ascii_alphanumeric() && !"._-".contains(letter),
        "-",
    )
}

#[cfg(test)]
mod tests {
    use std::fs;

    use super::*;

    fn key(sha256: &str) -> CellKey {
        CellKey {
            method: "script:fusion/mine.pt".parse().unwrap(),
            sha256: sha256.repeat(32),
            provenance: Provenance::default(),
        }
    }

    #[test]
    fn a_method_in_a_folder_is_cached_and_another_key_is_another_cell() {
        let folder = tempfile::tempdir().unwrap();
        let cell = Cell {
            key: key("0a"),
            metrics: Metrics::default(),
            used: 3,
            messages: Messages::default(),
            wall_seconds: 0.5,
        };
        cell.write(folder.path()).unwrap();
        let cached = Cell::read(&cell.key, folder.path()).unwrap();
        assert_eq!(cached.as_ref(), Some(&cell));
        assert_eq!(Cell::read(&key("0b"), folder.path()).unwrap(), None);
        let mut wrong = cell.clone();
        wrong.metrics.ap_global.at_50 = Some(1.5);
        let file = cell.key.file(folder.path());
        assert!(file.ends_with("script-fusion-mine.pt-0a0a0a0a0a0a0a0a0a0a0a0a.json"));
        let text = fs::read_to_string(&file).unwrap();
        let wrong = serde_json::to_string(&wrong).unwrap();
        // Torn, empty, and with an impossible precision.
        for text in [&text[..300], "", wrong.as_str()] {
            fs::write(&file, text).unwrap();
            assert_eq!(Cell::read(&cell.key, folder.path()).unwrap(), None);
        }
    }
}
