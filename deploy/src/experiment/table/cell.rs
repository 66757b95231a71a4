//! One number of a table, kept on disk under everything that decides it.

use std::fs;
use std::path::{Path, PathBuf};

use agent::attack::AttackConfig;
use dataset::evaluation_protocol::ProtocolConfig;
use ego_fuser::misbehaviour::MisbehaviourConfig;
use fusion::Method;
use localization::pose_source::PoseSourceConfig;
use protocol::text::hex;
use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};
use support::atomic_file;

use super::TableError;
use crate::experiment::fingerprint::hash_file;
use crate::experiment::metrics::Metrics;

/// Everything that decides a cell.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct CellKey {
    /// The method.
    pub method: Method,
    /// SHA-256 of its weights.
    pub weights_sha256: String,
    /// SHA-256 over the contents of the data ([`dataset::content_sha256`]).
    pub data_sha256: String,
    /// Where poses come from.
    pub poses: PoseSourceConfig,
    /// SHA-256 of each file that poses come from.
    pub poses_sha256: Vec<String>,
    /// How long messages are under way, milliseconds.
    pub delay_ms: u64,
    /// How exactly feature values cross the air.
    pub dtype: protocol::Dtype,
    /// Frames at most.
    pub frames: Option<usize>,
    /// Scenarios at most, evenly spread.
    #[serde(default)]
    pub scenarios: Option<usize>,
    /// Neighbours that lie.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub attack: Option<AttackConfig>,
    /// When the ego leaves out neighbours that it does not trust.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub trust: Option<MisbehaviourConfig>,
    /// The protocol that was asked for.
    #[serde(default, skip_serializing_if = "is_default")]
    pub protocol: ProtocolConfig,
    /// Boxes at or below this score are not judged.
    pub score_threshold: f32,
    /// Version of the program.
    pub version: String,
}

fn is_default(protocol: &ProtocolConfig) -> bool {
    *protocol == ProtocolConfig::default()
}

/// A cell that is done.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Cell {
    /// What decided it.
    pub key: CellKey,
    /// The weights' file, as it was called.
    pub weights: PathBuf,
    /// Commit of the program that computed it, where that is known.
    pub commit: String,
    /// The numbers.
    pub metrics: Metrics,
}

impl CellKey {
    /// The file that the cell is kept in.
    pub(super) fn file(&self, folder: &Path) -> PathBuf {
        let text = serde_json::to_string(self).unwrap_or_default();
        let digest = Sha256::digest(text.as_bytes());
        let name = hex(&digest[..12]);
        folder.join(format!("{}-{name}.json", self.method))
    }
}

impl Cell {
    /// The cell as it was kept; nothing where it was not.
    ///
    /// # Errors
    /// [`TableError::Spec`] when the file says something else.
    pub(super) fn read(key: &CellKey, folder: &Path) -> Result<Option<Self>, TableError> {
        let path = key.file(folder);
        let Ok(text) = fs::read_to_string(&path) else { return Ok(None) };
        let cell: Self = serde_json::from_str(&text)
            .map_err(|error| TableError::Spec { path: path.clone(), problem: error.to_string() })?;
        Ok((cell.key == *key).then_some(cell))
    }

    /// Keeps the cell; a file appears only when it is whole.
    ///
    /// # Errors
    /// [`TableError::Io`] when it cannot be written.
    pub(super) fn write(&self, folder: &Path) -> Result<(), TableError> {
        let path = self.key.file(folder);
        let text = serde_json::to_string_pretty(self).unwrap_or_default();
        atomic_file::write(&path, text).map_err(|source| TableError::Io { path, source })
    }
}

/// SHA-256 of the files that poses come from.
///
/// # Errors
/// [`TableError::Io`] names the file that cannot be read.
pub(super) fn pose_files(poses: &PoseSourceConfig) -> Result<Vec<String>, TableError> {
    let files: Vec<&PathBuf> = match poses {
        PoseSourceConfig::Recorded => vec![],
        PoseSourceConfig::Noisy(noisy) => noisy.table.iter().collect(),
        PoseSourceConfig::Pgc(pgc) => vec![&pgc.encoder, &pgc.head],
        PoseSourceConfig::EndToEnd(network) => vec![&network.weights],
        PoseSourceConfig::Cached(cached) => vec![&cached.file],
    };
    files.into_iter().map(|file| sha256(file)).collect()
}

/// SHA-256 of a file.
///
/// # Errors
/// [`TableError::Io`] names it.
pub(super) fn sha256(path: &Path) -> Result<String, TableError> {
    let hashed = hash_file(path).map_err(|source| TableError::Io { path: path.to_owned(), source });
    Ok(hashed?.1)
}
