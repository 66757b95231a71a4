//! One cell of a table, cached on disk by all its inputs.

use std::fs;
use std::path::{Path, PathBuf};

use agent::attack::AttackConfig;
use dataset::evaluation_protocol::ProtocolConfig;
use deploy::score::metrics::Metrics;
use ego_fuser::misbehaviour::MisbehaviourConfig;
use fusion::Method;
use localization::pose_source::PoseSourceConfig;
use perception::int8::InferencePrecision;
use protocol::text::hex;
use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};
use support::atomic_file;

use super::TableError;
use crate::scenario::fingerprint::hash_file;

/// All inputs of a cell, the key of the cache.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct CellKey {
    /// Fusion method.
    pub method: Method,
    /// SHA-256 of its weights.
    pub weights_sha256: String,
    /// Number format in which networks are computed.
    #[serde(default)]
    pub precision: InferencePrecision,
    /// SHA-256 over the contents of the data ([`dataset::content_sha256`]).
    pub data_sha256: String,
    /// Pose source.
    pub poses: PoseSourceConfig,
    /// SHA-256 of each file of the pose source.
    pub poses_sha256: Vec<String>,
    /// Delay of messages, milliseconds.
    pub delay_ms: u64,
    /// Number format of transmitted feature values.
    pub dtype: protocol::Dtype,
    /// Largest number of frames.
    pub frames: Option<usize>,
    /// Largest number of scenarios, evenly spread.
    #[serde(default)]
    pub scenarios: Option<usize>,
    /// Attack by neighbours.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub attack: Option<AttackConfig>,
    /// Misbehaviour detection of the ego.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub trust: Option<MisbehaviourConfig>,
    /// Requested protocol.
    #[serde(default, skip_serializing_if = "is_default")]
    pub protocol: ProtocolConfig,
    /// Score at or below which boxes are ignored.
    pub score_threshold: f32,
    /// Version of the program.
    pub version: String,
}

fn is_default(protocol: &ProtocolConfig) -> bool {
    *protocol == ProtocolConfig::default()
}

/// A completed cell.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Cell {
    /// Its inputs.
    pub key: CellKey,
    /// Path of the weights' file at that time.
    pub weights: PathBuf,
    /// Commit of the program that computed it, if known.
    pub commit: String,
    /// Its metrics.
    pub metrics: Metrics,
}

impl CellKey {
    /// Cache file of the cell.
    pub(super) fn file(&self, folder: &Path) -> PathBuf {
        let text = serde_json::to_string(self).unwrap_or_default();
        let digest = Sha256::digest(text.as_bytes());
        let name = hex(&digest[..12]);
        folder.join(format!("{}-{name}.json", self.method))
    }
}

impl Cell {
    /// The cached cell; `None` if it does not exist.
    ///
    /// # Errors
    /// [`TableError::Spec`] when the file belongs to other inputs.
    pub(super) fn read(key: &CellKey, folder: &Path) -> Result<Option<Self>, TableError> {
        let path = key.file(folder);
        let Ok(text) = fs::read_to_string(&path) else {
            return Ok(None);
        };
        let cell: Self = serde_json::from_str(&text).map_err(|error| TableError::Spec {
            path: path.clone(),
            problem: error.to_string(),
        })?;
        Ok((cell.key == *key).then_some(cell))
    }

    /// Caches the cell; the file appears only when it is complete.
    ///
    /// # Errors
    /// [`TableError::Io`] when it cannot be written.
    pub(super) fn write(&self, folder: &Path) -> Result<(), TableError> {
        let path = self.key.file(folder);
        let text = serde_json::to_string_pretty(self).unwrap_or_default();
        atomic_file::write(&path, text).map_err(|source| TableError::Io { path, source })
    }
}

/// SHA-256 of the files of a pose source.
///
/// # Errors
/// [`TableError::Io`] names the file that cannot be read.
pub(super) fn pose_files(poses: &PoseSourceConfig) -> Result<Vec<String>, TableError> {
    poses.files().into_iter().map(sha256).collect()
}

/// SHA-256 of a file.
///
/// # Errors
/// [`TableError::Io`] names it.
pub(super) fn sha256(path: &Path) -> Result<String, TableError> {
    let hashed = hash_file(path).map_err(|source| TableError::Io {
        path: path.to_owned(),
        source,
    });
    Ok(hashed?.1)
}
