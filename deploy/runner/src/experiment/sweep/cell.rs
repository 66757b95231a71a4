//! One run of a sweep: computed, and cached on disk by all its inputs.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::time::Instant;
use std::{env, fs};

use dataset::IntensityScale;
use dataset::evaluation_protocol::ProtocolConfig;
use deploy::score::metrics::Metrics;
use ego_fuser::config::EgoSettings;
use ego_fuser_offline::evaluation::EvaluateError;
use ego_fuser_offline::evaluation::stepped::ComputeTimes;
use fusion::Exchange;
use link::LinkConfig;
use localization::pose_source::PoseSourceConfig;
use perception::int8::InferencePrecision;
use perception::model_config::DetectorConfig;
use perception::weights::Weights;
use protocol::text::hex;
use protocol::{Counts, DropReason, Dtype, Stream, Topic};
use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};
use support::atomic_file;
use training::feature_store::KeptMaps;

use super::SweepError;
use super::grid::{self, Point};
use super::spec::Experiment;
use crate::experiment::evaluation::{EvaluationError, EvaluationOptions, judged, metrics};
use crate::scenario::fingerprint::hash_file;
use crate::scenario::weights_choice::weights_of;

/// All inputs of a run, the key of the cache.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct CellKey {
    /// Point of the grid.
    pub point: Point,
    /// Complete settings of the link.
    pub link: LinkConfig,
    /// SHA-256 of the trace that the link names, if any.
    pub trace_sha256: Option<String>,
    /// Deadline, age and trust settings of the ego.
    pub ego: EgoSettings,
    /// Requested protocol.
    #[serde(default)]
    pub protocol: ProtocolConfig,
    /// Compute times of the stages.
    pub compute: ComputeTimes,
    /// Pose source.
    pub poses: PoseSourceConfig,
    /// SHA-256 of each file of the pose source.
    pub poses_sha256: Vec<String>,
    /// SHA-256 of the weights.
    pub weights_sha256: String,
    /// Number format in which networks are computed.
    #[serde(default)]
    pub precision: InferencePrecision,
    /// SHA-256 over the part of the data that is evaluated ([`dataset::content_sha256`]).
    pub data_sha256: String,
    /// SHA-256 of the program: results of another one are not reused.
    pub program_sha256: String,
}

/// A completed run.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Cell {
    /// Its inputs.
    pub key: CellKey,
    /// Its metrics.
    pub metrics: Metrics,
    /// Number of neighbours' messages that were fused, over all frames.
    pub used: u64,
    /// Counts of the messages that are fused: feature maps, boxes or points, without the pose messages.
    pub messages: MessageCounts,
    /// Compute time, seconds: for estimates, never for results.
    pub wall_seconds: f64,
}

/// Message counts.
#[derive(Debug, Clone, PartialEq, Eq, Default, Serialize, Deserialize)]
pub struct MessageCounts {
    /// Sent, including duplicates by the link.
    pub sent: u64,
    /// Used at least once.
    pub received: u64,
    /// In flight at the end of the scene.
    pub in_flight: u64,
    /// Not used, by reason.
    pub dropped: BTreeMap<DropReason, u64>,
}

impl From<Counts> for MessageCounts {
    fn from(counts: Counts) -> Self {
        let Counts {
            sent,
            received,
            in_flight,
            dropped,
            adapted: _,
        } = counts;
        Self {
            sent,
            received,
            in_flight,
            dropped,
        }
    }
}

impl CellKey {
    /// Cache file of the run.
    #[must_use]
    pub fn file(&self, folder: &Path) -> PathBuf {
        let text = serde_json::to_string(self).unwrap_or_default();
        let digest = Sha256::digest(text.as_bytes());
        let name = hex(&digest[..12]);
        folder.join(format!("{}-{name}.json", self.point.method))
    }
}

impl Cell {
    /// The cached run; `None` if it does not exist, or belongs to other inputs.
    ///
    /// # Errors
    /// [`SweepError::Spec`] when the file is no cached run.
    pub fn read(key: &CellKey, folder: &Path) -> Result<Option<Self>, SweepError> {
        let path = key.file(folder);
        let Ok(text) = fs::read_to_string(&path) else {
            return Ok(None);
        };
        let cell: Self = serde_json::from_str(&text).map_err(|error| SweepError::Spec {
            path: path.clone(),
            problem: error.to_string(),
        })?;
        Ok((cell.key == *key).then_some(cell))
    }

    /// Caches the run; the file appears only when it is complete.
    ///
    /// # Errors
    /// [`SweepError::Io`] when it cannot be written.
    pub fn write(&self, folder: &Path) -> Result<(), SweepError> {
        let path = self.key.file(folder);
        let text = serde_json::to_string_pretty(self).unwrap_or_default();
        atomic_file::write(&path, text).map_err(|source| SweepError::Io { path, source })
    }
}

/// Hashes of the inputs of runs, each computed once.
#[derive(Debug, Clone)]
pub(super) struct Hashes {
    data_sha256: String,
    files: BTreeMap<PathBuf, String>,
}

impl Hashes {
    pub(super) fn new(data_sha256: String) -> Self {
        Self {
            data_sha256,
            files: BTreeMap::new(),
        }
    }

    fn of(&mut self, path: &Path) -> Result<String, SweepError> {
        if let Some(known) = self.files.get(path) {
            return Ok(known.clone());
        }
        let (_, hash) = hash_file(path).map_err(|source| SweepError::Io {
            path: path.to_owned(),
            source,
        })?;
        self.files.insert(path.to_owned(), hash.clone());
        Ok(hash)
    }

    /// All inputs of the run of a point.
    pub(super) fn key(
        &mut self,
        experiment: &Experiment,
        point: &Point,
    ) -> Result<CellKey, SweepError> {
        let (link, folder) = point.link(experiment)?;
        let poses = point.poses(experiment);
        let poses_sha256 = poses
            .files()
            .into_iter()
            .map(|file| self.of(file))
            .collect::<Result<_, _>>()?;
        let trace_sha256 = link
            .trace_file()
            .map(|file| self.of(&folder.join(file)))
            .transpose()?;
        let weights_sha256 = self.of(&weights_of(&experiment.weights, point.method)?)?;
        let program = env::current_exe().map_err(|source| SweepError::Io {
            path: "this program".into(),
            source,
        })?;
        Ok(CellKey {
            point: point.clone(),
            link,
            trace_sha256,
            ego: experiment.ego.clone(),
            protocol: experiment.protocol.clone(),
            compute: experiment.compute,
            poses,
            poses_sha256,
            weights_sha256,
            precision: experiment.precision,
            data_sha256: self.data_sha256.clone(),
            program_sha256: self.of(&program)?,
        })
    }
}

/// Settings of the evaluation of a point.
pub(super) fn options(
    experiment: &Experiment,
    point: &Point,
    maps: &Path,
) -> Result<EvaluationOptions, SweepError> {
    let weights = weights_of(&experiment.weights, point.method)?;
    let read = Weights::load(&weights)
        .map_err(EvaluateError::from)
        .map_err(boxed)?;
    let config: DetectorConfig = read.config().map_err(EvaluateError::from).map_err(boxed)?;
    let channels = u64::try_from(config.sent_channels()).unwrap_or(0);
    Ok(EvaluationOptions {
        dataset: experiment.dataset.clone(),
        weights,
        precision: experiment.precision,
        pose_source: point.poses(experiment),
        codec: point.codec(config.feature_grid(), channels),
        rate: point.rate(),
        trust: experiment.ego.trust(),
        maps: (point.method.exchange() != Exchange::Points).then(|| kept_maps(experiment, maps)),
        stepped: Some(grid::stepped(
            point.link(experiment)?,
            point,
            &experiment.ego,
            experiment.compute,
        )),
        part: experiment.part(),
        protocol: experiment.protocol.clone(),
        ..EvaluationOptions::default()
    })
}

/// Feature maps are cached losslessly, so that the cache changes no result.
pub(super) fn kept_maps(experiment: &Experiment, folder: &Path) -> KeptMaps {
    let limit_bytes = (experiment.maps_limit_gb * 1e9) as u64;
    KeptMaps {
        folder: folder.to_owned(),
        dtype: Dtype::F32,
        limit_bytes,
        intensity_scale: IntensityScale::AUTO,
    }
}

/// Computes the run of a point; `on_frame` is called after every frame.
pub(super) fn compute(
    experiment: &Experiment,
    point: &Point,
    key: CellKey,
    maps: &Path,
    on_frame: &mut dyn FnMut(),
) -> Result<Cell, SweepError> {
    let began = Instant::now();
    let options = options(experiment, point, maps)?;
    let (board, evaluator, _) = judged(&options, point.method, on_frame).map_err(Box::new)?;
    let metrics = metrics(&board, &evaluator, &options, began);
    let used = board
        .records()
        .iter()
        .map(|record| record.fused as u64)
        .sum();
    let mut messages = Counts::default();
    for (account, counts) in evaluator.ledger().iter() {
        if !matches!(
            account.topic,
            Topic::Stream {
                stream: Stream::Pose,
                ..
            }
        ) {
            messages.add(counts);
        }
    }
    Ok(Cell {
        key,
        metrics,
        used,
        messages: messages.into(),
        wall_seconds: began.elapsed().as_secs_f64(),
    })
}

fn boxed(error: EvaluateError) -> SweepError {
    SweepError::Evaluation(Box::new(EvaluationError::from(error)))
}
