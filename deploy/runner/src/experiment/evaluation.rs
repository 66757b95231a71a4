//! Evaluation of one cell of an experiment: a method on recorded scenes, with or without link emulation.

use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex};
use std::time::Instant;

use agent::config::AgentSettings;
use anyhow::{Context, Result, anyhow, ensure};
use dataset::evaluation_protocol::{EvaluationProtocol, ProtocolConfig};
use dataset::{self, IntensityScale, OpenOptions, ReadError, Scenario, findings};
use deploy::score::FrameScores;
use deploy::score::metrics::{Messages, Metrics};
use ego_fuser_offline::evaluation::stepped::ComputeTimes;
use ego_fuser_offline::evaluation::{Evaluator, Setup};
use fusion::{Exchange, Method};
use perception::int8::InferencePrecision;
use perception::weights::Weights;
use protocol::{Counts, Stream, Topic};
use support::cli::NotWritten;
use support::file_digests::FileDigests;
use support::provenance::Provenance;
use support::sampling::evenly_spread;
use support::sync::lock;
use training::feature_store::{FeatureStore, KeptMaps, MapSource};

use crate::evaluated_frame::{judge, metrics};
use crate::experiment::cell::{Cell, CellKey};
use crate::experiment::frame_files::{self, FrameFiles};
use crate::scenario::fingerprint::files_of;
use crate::scenario::weights_choice::weights_of;

/// A cell of an experiment: vehicles, ego and link as in a run, and the part of a data set that they see.
#[derive(Debug, Clone, Default)]
pub struct Trial {
    /// Data set, split or scenario.
    pub dataset: PathBuf,
    /// Number of scenarios, evenly spread; absent: all. `setup.frames` is of each.
    pub scenarios: Option<usize>,
    /// Divisor of the intensities of its sweeps.
    pub intensity_scale: IntensityScale,
    /// Participating vehicles, counted annotations and objects.
    pub protocol: ProtocolConfig,
    /// Vehicles, ego and delivery. The weights may be a folder with those of several methods; `method` and `protocol`
    /// follow from the method that is evaluated and from the data set.
    pub setup: Setup,
    /// Cache of the encoders' feature maps, so that each is computed once for many evaluations.
    pub maps: Option<KeptMaps>,
    /// Folder for detections, ground truth, a row per frame, and precision over recall, a folder per method in it;
    /// absent: none are written.
    pub out: Option<PathBuf>,
}

/// Data set, opened for evaluation by a protocol.
#[derive(Debug)]
pub struct OpenedData {
    /// Scenarios, with the participating agents.
    pub scenarios: Vec<Scenario>,
    /// Evaluation protocol.
    pub protocol: EvaluationProtocol,
    /// Parts of the data set that cannot be used.
    pub problems: Vec<ReadError>,
    /// Digests of the files that were read so far.
    pub digests: FileDigests,
    /// SHA-256 of each part that was asked for, by the number of its scenarios and the variant of its sweeps.
    parts: Mutex<BTreeMap<DataPart, String>>,
}

/// Number of scenarios, and variant of the sweeps.
type DataPart = (Option<usize>, Option<String>);

impl OpenedData {
    /// Opens the data set of a trial: all its scenarios, each with the agents of the protocol and the requested frames.
    /// Feature maps are cached for all of them, so that another selection needs no others.
    ///
    /// # Errors
    /// An error when it cannot be read, or the protocol contradicts itself.
    pub fn open(trial: &Trial) -> Result<Self> {
        let options = OpenOptions::with_intensity_scale(trial.intensity_scale);
        let dataset = dataset::open_with(&trial.dataset, &options)?;
        let protocol = trial.protocol.resolve(dataset.layout);
        let protocol = protocol.map_err(|error| anyhow!("evaluation protocol: {error}"))?;
        let all = dataset.scenarios.iter();
        let arranged = all.filter_map(|scenario| protocol.arrange(scenario));
        let mut scenarios: Vec<Scenario> = arranged.collect();
        let frames = trial.setup.frames.unwrap_or(usize::MAX);
        for scenario in &mut scenarios {
            scenario.ticks.truncate(frames);
        }
        Ok(Self {
            scenarios,
            protocol,
            problems: dataset.problems,
            digests: FileDigests::default(),
            parts: Mutex::default(),
        })
    }

    /// So many scenarios, evenly spread.
    pub fn chosen(&self, scenarios: Option<usize>) -> impl Iterator<Item = &Scenario> {
        let all: Vec<&Scenario> = self.scenarios.iter().collect();
        evenly_spread(&all, scenarios.unwrap_or(usize::MAX)).into_iter()
    }

    /// Number of frames of so many scenarios.
    pub fn frame_count(&self, scenarios: Option<usize>) -> usize {
        let chosen = self.chosen(scenarios);
        chosen.map(|scenario| scenario.ticks.len()).sum()
    }

    /// SHA-256 of a part and of a variant of its sweeps ([`dataset::content_sha256`]), which is computed once.
    fn sha256(&self, scenarios: Option<usize>, variant: Option<&str>) -> String {
        let mut parts = lock(&self.parts);
        let place = (scenarios, variant.map(str::to_owned));
        let sha256 = parts.entry(place).or_insert_with(|| {
            dataset::content_sha256(self.chosen(scenarios), variant, &self.digests)
        });
        sha256.clone()
    }
}

impl Trial {
    fn metrics(
        &self,
        scores: &FrameScores,
        evaluator: &Evaluator,
        provenance: Provenance,
        began: Instant,
    ) -> Metrics {
        // Over a link the time of the scene passes. Without one only the time of computing is known.
        let (clock, seconds) = match self.setup.link {
            Some(_) => ("stepped", scores.seconds()),
            None => ("offline", began.elapsed().as_secs_f64()),
        };
        let poses = self.setup.agents.pose.name();
        let metrics = metrics(scores, evaluator, clock, poses, seconds);
        Metrics {
            provenance: Some(provenance.with_command()),
            ..metrics
        }
    }

    /// Identity of the result of a method: these settings, and the digests of all that they are applied to.
    ///
    /// # Errors
    /// An error that names the file that cannot be read.
    pub fn key(&self, data: &OpenedData, method: Method) -> Result<CellKey> {
        let provenance = self.provenance(data, method)?;
        // The contents of data and weights count, their places do not; kept maps change no result.
        let mut settings = Self {
            dataset: PathBuf::new(),
            maps: None,
            out: None,
            ..self.clone()
        };
        let setup = &mut settings.setup;
        setup.models.weights = PathBuf::new();
        let vehicles = setup.vehicles.values_mut();
        // Only whether a vehicle has weights of its own counts here: their contents are in the provenance.
        for settings in std::iter::once(&mut setup.agents).chain(vehicles) {
            settings.weights = settings.weights.take().map(|_| PathBuf::new());
        }
        Ok(CellKey {
            method,
            // The debug text has every field, so a new setting changes the key by itself.
            sha256: provenance.key(&format!("{method} {settings:?}")),
            provenance,
        })
    }

    /// Settings of all vehicles, then those of single ones.
    fn settings(&self) -> impl Iterator<Item = &AgentSettings> {
        std::iter::once(&self.setup.agents).chain(self.setup.vehicles.values())
    }

    /// True if a vehicle sends boxes where a method fuses feature maps.
    fn sends_boxes(&self) -> bool {
        self.settings().any(|settings| settings.boxes.is_some())
    }

    /// Digests of all that these settings are applied to.
    fn provenance(&self, data: &OpenedData, method: Method) -> Result<Provenance> {
        let setup = &self.setup;
        let link = setup.link.as_ref();
        let link = link.map(|link| (&link.config, link.folder.as_path()));
        let weights = weights_of(&setup.models.weights, method, self.sends_boxes())?;
        let files = files_of(method, weights, self.settings(), link);
        let data_sha256 = data.sha256(self.scenarios, setup.lidar_variant.as_deref());
        let (commit, digests) = (env!("V2VLOC_COMMIT"), &data.digests);
        let collected = Provenance::collect(&[], data_sha256, files, commit, digests);
        Ok(collected?)
    }
}

/// Evaluates one method over the chosen scenarios, the first vehicle of each being the ego; `on_frame` is called after
/// every frame. Frames and parts that cannot be read are left out and counted in [`Metrics::left_out`].
///
/// # Errors
/// An error when no frame can be evaluated.
pub fn evaluate(
    trial: &Trial,
    data: &OpenedData,
    method: Method,
    on_frame: &mut dyn FnMut(),
) -> Result<Metrics> {
    let began = Instant::now();
    let (scores, evaluator) = judged(trial, data, method, on_frame)?;
    let provenance = trial.provenance(data, method)?;
    let metrics = trial.metrics(&scores, &evaluator, provenance, began);
    if let Some(out) = &trial.out {
        frame_files::write_metrics(out, method, &metrics)?;
    }
    Ok(metrics)
}

/// [`evaluate`] for the cell of a key.
///
/// # Errors
/// As [`evaluate`].
pub fn compute(
    trial: &Trial,
    data: &OpenedData,
    key: CellKey,
    on_frame: &mut dyn FnMut(),
) -> Result<Cell> {
    let began = Instant::now();
    let (scores, evaluator) = judged(trial, data, key.method, on_frame)?;
    let mut messages = Counts::default();
    for (account, counts) in evaluator.ledger().iter() {
        let is_pose =
            matches!(&account.topic, Topic::Stream { stream, .. } if *stream == Stream::Pose);
        if !is_pose {
            messages.add(counts);
        }
    }
    let used = scores.records().iter().map(|record| record.fused as u64);
    let provenance = key.provenance.clone();
    Ok(Cell {
        key,
        metrics: trial.metrics(&scores, &evaluator, provenance, began),
        used: used.sum(),
        messages: Messages::of(&messages),
        wall_seconds: began.elapsed().as_secs_f64(),
    })
}

/// Scores of all frames, and the evaluator with its accounts.
fn judged(
    trial: &Trial,
    data: &OpenedData,
    method: Method,
    on_frame: &mut dyn FnMut(),
) -> Result<(FrameScores, Evaluator)> {
    let weights = &trial.setup.models.weights;
    let weights = weights_of(weights, method, trial.sends_boxes())?;
    let mut setup = Setup {
        method: Some(method),
        protocol: Some(data.protocol.clone()),
        ..trial.setup.clone()
    };
    setup.models.weights.clone_from(&weights);
    let precision = setup.models.precision;
    let mut evaluator = Evaluator::new(setup)?;
    let kept = trial.maps.as_ref();
    // Early fusion encodes merged clouds, for which maps of single sweeps are of no use.
    if let Some(kept) = kept.filter(|_| method.exchange() != Exchange::Points) {
        evaluator = evaluator.with_maps(maps(kept, &weights, precision, data)?);
    }
    let findings = findings::sampled(&data.scenarios, trial.intensity_scale);
    evaluator.add_data_set(&data.problems, findings);
    let detector = evaluator.ego().detector().config();
    let map_values = detector.feature_grid().cells() as u64 * detector.sent_channels() as u64;
    // Without a compute time, a result is as old as its sweep by definition, which is no latency.
    let Setup { link, compute, .. } = &trial.setup;
    let is_timed = link.is_some() && *compute != ComputeTimes::default();
    let mut scores: Option<FrameScores> = None;
    let out = trial.out.as_ref();
    let mut files = out.map(|out| FrameFiles::create(out, method)).transpose()?;
    for scenario in data.chosen(trial.scenarios) {
        let Some(ego) = scenario.agents.first() else {
            continue;
        };
        ensure!(
            scenario.has_poses(0, 0),
            "scenario {} has no true poses of the ego {ego}: its results cannot be evaluated",
            scenario.name
        );
        // One set of scores over all scenarios: AP orders the detections of all frames together.
        let scores = scores
            .get_or_insert_with(|| FrameScores::new(ego.clone(), *evaluator.rule(), map_values));
        scores.change_ego(ego);
        let judged = evaluator.run(scenario, &mut |frame| {
            let mut files = files.iter_mut();
            let written = files.try_for_each(|files| files.add(&scenario.name, &frame));
            judge(scores, frame, is_timed);
            on_frame();
            written
        })?;
        // A file could not be written. finish returns the error.
        if judged.is_break() {
            break;
        }
    }
    let scores = scores.filter(|scores| !scores.records().is_empty());
    let scores = scores.with_context(|| {
        let (path, reasons) = (trial.dataset.display(), evaluator.left_out().reasons());
        format!("{path}: there is no frame in it that can be evaluated{reasons}")
    })?;
    files.map(|files| files.finish(&scores)).transpose()?;
    Ok((scores, evaluator))
}

/// Feature maps of all sweeps, from the cache or encoded now.
fn maps(
    kept: &KeptMaps,
    weights: &Path,
    precision: InferencePrecision,
    data: &OpenedData,
) -> Result<MapSource> {
    let weights = Arc::new(Weights::load(weights)?.with_precision(precision));
    fs::create_dir_all(&kept.folder).with_context(|| NotWritten(kept.folder.clone()))?;
    let (scenarios, digests) = (&data.scenarios, &data.digests);
    let store = FeatureStore::open(kept, &weights, scenarios, digests, 1, &mut |_, _| {})?;
    Ok(MapSource::new(Arc::new(store), weights))
}
