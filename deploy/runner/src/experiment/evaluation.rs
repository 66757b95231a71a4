//! Offline evaluation of a method on recorded scenes: without delays, or with link emulation in simulation time.

use std::collections::BTreeMap;
use std::fs;
use std::ops::ControlFlow;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Instant;

use anyhow::{Context, Result, anyhow, ensure};
use dataset::evaluation_protocol::{EvaluationProtocol, ProtocolConfig};
use dataset::{self, IntensityScale, OpenOptions, ReadError, Scenario, findings};
use deploy::score::FrameScores;
use deploy::score::metrics::{Messages, Metrics};
use ego_fuser_offline::evaluation::stepped::{ComputeTimes, SteppedConfig};
use ego_fuser_offline::evaluation::{EvaluateConfig, Evaluator};
use fusion::{Exchange, Method};
use perception::int8::InferencePrecision;
use perception::weights::Weights;
use protocol::{Counts, Stream, Topic};
use support::cli::NotWritten;
use support::file_digests::FileDigests;
use support::provenance::Provenance;
use support::sampling::evenly_spread;
use training::feature_store::{FeatureStore, KeptMaps, MapSource};

use crate::evaluated_frame::{judge, metrics};
use crate::experiment::cell::{Cell, CellKey};
use crate::experiment::frame_files::{self, FrameFiles};
use crate::scenario::fingerprint::{collect, files_of};
use crate::scenario::weights_choice::weights_of;

/// Settings of an evaluation.
#[derive(Debug, Clone, Default)]
pub struct EvaluationOptions {
    /// Data set, split or scenario.
    pub dataset: PathBuf,
    /// Settings of vehicles and ego. `weights` may be a folder with those of several methods; `method` and `protocol`
    /// follow from the method that is evaluated and from the data set.
    pub settings: EvaluateConfig,
    /// Cache of the encoders' feature maps, so that each is computed once for many evaluations.
    pub maps: Option<KeptMaps>,
    /// Run in simulation time with link emulation; absent: no link.
    pub stepped: Option<SteppedConfig>,
    /// Part of the data set to evaluate.
    pub part: Part,
    /// Participating vehicles, counted annotations and objects.
    pub protocol: ProtocolConfig,
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
    /// SHA-256 of a part and of a variant of its sweeps ([`dataset::content_sha256`]), which is computed once.
    fn sha256(&self, part: &Part, variant: Option<&str>) -> String {
        let mut parts = self.parts.lock().unwrap_or_else(PoisonError::into_inner);
        let place = (part.scenarios, variant.map(str::to_owned));
        let sha256 = parts.entry(place).or_insert_with(|| {
            dataset::content_sha256(part.chosen(&self.scenarios), variant, &self.digests)
        });
        sha256.clone()
    }
}

/// A part of a data set.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Part {
    /// Number of scenarios, evenly spread; absent: all.
    pub scenarios: Option<usize>,
    /// Number of frames from the start of each scenario; absent: all.
    pub frames: Option<usize>,
    /// Divisor of the intensities of its sweeps.
    pub intensity_scale: IntensityScale,
}

impl Part {
    /// Opens a data set: all its scenarios, each with the agents of the protocol and the requested frames. Feature maps
    /// are cached for all of them, so that another selection needs no others.
    ///
    /// # Errors
    /// An error when it cannot be read, or the protocol contradicts itself.
    pub fn open(&self, path: &Path, protocol: &ProtocolConfig) -> Result<OpenedData> {
        let options = OpenOptions {
            intensity_scale: self.intensity_scale,
            ..OpenOptions::default()
        };
        let dataset = dataset::open_with(path, &options)?;
        let protocol = protocol.resolve(dataset.layout);
        let protocol = protocol.map_err(|error| anyhow!("evaluation protocol: {error}"))?;
        let mut scenarios: Vec<Scenario> = dataset
            .scenarios
            .iter()
            .filter_map(|scenario| protocol.arrange(scenario))
            .collect();
        scenarios
            .iter_mut()
            .for_each(|scenario| scenario.ticks.truncate(self.frames.unwrap_or(usize::MAX)));
        Ok(OpenedData {
            scenarios,
            protocol,
            problems: dataset.problems,
            digests: FileDigests::default(),
            parts: Mutex::default(),
        })
    }

    /// The requested scenarios.
    pub fn chosen<'a>(
        &self,
        scenarios: &'a [Scenario],
    ) -> impl Iterator<Item = &'a Scenario> + use<'a> {
        let all: Vec<&Scenario> = scenarios.iter().collect();
        evenly_spread(&all, self.scenarios.unwrap_or(usize::MAX)).into_iter()
    }
}

impl EvaluationOptions {
    /// Number of frames to evaluate, over all scenarios.
    #[must_use]
    pub fn frame_count(&self, data: &OpenedData) -> usize {
        let chosen = self.part.chosen(&data.scenarios);
        chosen.map(|scenario| scenario.ticks.len()).sum()
    }

    fn metrics(
        &self,
        board: &FrameScores,
        evaluator: &Evaluator,
        provenance: Provenance,
        began: Instant,
    ) -> Metrics {
        let (clock, seconds) = match self.stepped {
            Some(_) => ("stepped", board.seconds()),
            None => ("offline", began.elapsed().as_secs_f64()),
        };
        let poses = self.settings.pose_source.name();
        let metrics = metrics(board, evaluator, clock, poses, seconds);
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
        settings.settings.weights = PathBuf::new();
        Ok(CellKey {
            method,
            sha256: provenance.key(&format!("{method} {settings:?}")),
            provenance,
        })
    }

    /// Digests of all that these settings are applied to.
    fn provenance(&self, data: &OpenedData, method: Method) -> Result<Provenance> {
        let stepped = self.stepped.as_ref();
        let link = stepped.map(|stepped| (&stepped.link, stepped.link_folder.as_path()));
        let variant = stepped.and_then(|stepped| stepped.lidar_variant.as_deref());
        let vehicles = stepped.into_iter().flat_map(|stepped| &stepped.vehicles);
        let poses = std::iter::once(&self.settings.pose_source)
            .chain(vehicles.map(|(_, vehicle)| &vehicle.pose));
        let weights = weights_of(&self.settings.weights, method)?;
        let files = files_of(method, weights, poses, link);
        let data_sha256 = data.sha256(&self.part, variant);
        Ok(collect(&[], data_sha256, files, &data.digests)?)
    }
}

/// Evaluates one method over the chosen scenarios, the first vehicle of each being the ego; `on_frame` is called after
/// every frame. Frames and parts that cannot be read are left out and counted in [`Metrics::left_out`].
///
/// # Errors
/// An error when no frame can be evaluated.
pub fn evaluate(
    options: &EvaluationOptions,
    data: &OpenedData,
    method: Method,
    on_frame: &mut dyn FnMut(),
) -> Result<Metrics> {
    let began = Instant::now();
    let (board, evaluator) = judged(options, data, method, on_frame)?;
    let provenance = options.provenance(data, method)?;
    let metrics = options.metrics(&board, &evaluator, provenance, began);
    if let Some(out) = &options.out {
        frame_files::write_metrics(out, method, &metrics)?;
    }
    Ok(metrics)
}

/// [`evaluate`] for the cell of a key.
///
/// # Errors
/// As [`evaluate`].
pub fn compute(
    options: &EvaluationOptions,
    data: &OpenedData,
    key: CellKey,
    on_frame: &mut dyn FnMut(),
) -> Result<Cell> {
    let began = Instant::now();
    let (board, evaluator) = judged(options, data, key.method, on_frame)?;
    let mut messages = Counts::default();
    for (account, counts) in evaluator.ledger().iter() {
        match account.topic {
            Topic::Stream {
                stream: Stream::Pose,
                ..
            } => {}
            _ => messages.add(counts),
        }
    }
    let used = board.records().iter().map(|record| record.fused as u64);
    let provenance = key.provenance.clone();
    Ok(Cell {
        key,
        metrics: options.metrics(&board, &evaluator, provenance, began),
        used: used.sum(),
        messages: Messages::of(&messages),
        wall_seconds: began.elapsed().as_secs_f64(),
    })
}

/// Scores of all frames, and the evaluator with its accounts.
fn judged(
    options: &EvaluationOptions,
    data: &OpenedData,
    method: Method,
    on_frame: &mut dyn FnMut(),
) -> Result<(FrameScores, Evaluator)> {
    let scenarios = &data.scenarios;
    let (weights, precision) = (
        weights_of(&options.settings.weights, method)?,
        options.settings.precision,
    );
    let mut evaluator = Evaluator::new(EvaluateConfig {
        weights: weights.clone(),
        method: Some(method),
        protocol: Some(data.protocol.clone()),
        ..options.settings.clone()
    })?;
    let kept = options.maps.as_ref();
    if let Some(kept) = kept.filter(|_| method.exchange() != Exchange::Points) {
        evaluator = evaluator.with_maps(maps(kept, &weights, precision, data)?);
    }
    if let Some(stepped) = &options.stepped {
        evaluator = evaluator.with_link(stepped.clone());
    }
    let findings = findings::sampled(scenarios, options.part.intensity_scale);
    evaluator.add_data_set(&data.problems, findings);
    let detector = evaluator.ego().detector().config();
    let map_values = detector.feature_grid().cells() as u64 * detector.sent_channels() as u64;
    // Without a compute time, a result is as old as its sweep by definition, which is no latency.
    let stepped = options.stepped.as_ref();
    let is_timed = stepped.is_some_and(|stepped| stepped.compute != ComputeTimes::NONE);
    let mut board: Option<FrameScores> = None;
    let out = options.out.as_ref();
    let mut files = out.map(|out| FrameFiles::create(out, method)).transpose()?;
    for scenario in options.part.chosen(scenarios) {
        let Some(ego) = scenario.agents.first() else {
            continue;
        };
        ensure!(
            scenario.has_poses(0, 0),
            "scenario {} has no true poses of the ego {ego}: its results cannot be evaluated",
            scenario.name
        );
        let board = board
            .get_or_insert_with(|| FrameScores::new(ego.clone(), *evaluator.rule(), map_values));
        board.change_ego(ego);
        let judged = evaluator.run(scenario, &mut |frame| {
            let mut files = files.iter_mut();
            let is_written = files.all(|files| files.add(&scenario.name, &frame));
            judge(board, frame, is_timed);
            on_frame();
            match is_written {
                true => ControlFlow::Continue(()),
                false => ControlFlow::Break(()),
            }
        })?;
        if judged.is_break() {
            break;
        }
    }
    let board = board.filter(|board| !board.records().is_empty());
    let board = board.with_context(|| {
        let (path, reasons) = (options.dataset.display(), evaluator.left_out().reasons());
        format!("{path}: there is no frame in it that can be evaluated{reasons}")
    })?;
    files.map(|files| files.finish(&board)).transpose()?;
    Ok((board, evaluator))
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
