//! Offline evaluation of a method on recorded scenes: without delays, or with link emulation in simulation time.

use std::collections::BTreeMap;
use std::io;
use std::ops::ControlFlow;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Instant;

use agent::attack::AttackConfig;
use agent::rate::RateConfig;
use dataset::evaluation_protocol::{EvaluationProtocol, ProtocolConfig};
use dataset::{self, IntensityScale, OpenOptions, ReadError, Scenario, findings};
use deploy::score::FrameScores;
use deploy::score::metrics::{Messages, Metrics};
use ego_fuser::misbehaviour::MisbehaviourConfig;
use ego_fuser_offline::evaluation::stepped::{ComputeTimes, SteppedConfig};
use ego_fuser_offline::evaluation::{EvaluateConfig, EvaluateError, Evaluator};
use fusion::Exchange;
use fusion::Method;
use localization::pose_source::PoseSourceConfig;
use perception::int8::InferencePrecision;
use perception::weights::Weights;
use protocol::{CavId, CodecConfig, Counts, Stream, Topic};
use support::file_digests::FileDigests;
use support::provenance::Provenance;
use support::sampling::evenly_spread;
use training::feature_store::{FeatureStore, KeptMaps, MapSource};

use crate::evaluated_frame::{judge, metrics};
use crate::experiment::cell::{Cell, CellKey};
use crate::experiment::frame_files::{self, FrameFiles, FrameFilesError};
use crate::scenario::fingerprint::{collect, files_of};
use crate::scenario::weights_choice::{WeightsChoiceError, weights_of};

/// Settings of an evaluation.
#[derive(Debug, Clone, Default)]
pub struct EvaluationOptions {
    /// Data set, split or scenario.
    pub dataset: PathBuf,
    /// Weights of the detector, or a folder that holds a file `<name>-<method>.safetensors` for each method.
    pub weights: PathBuf,
    /// Number format in which networks are computed.
    pub precision: InferencePrecision,
    /// Source of the vehicles' poses.
    pub pose_source: PoseSourceConfig,
    /// Encoding of feature maps.
    pub codec: CodecConfig,
    /// Adaptation of feature maps to the rate of the link.
    pub rate: RateConfig,
    /// Delay of the messages of neighbours, nanoseconds.
    pub delay_nanos: u64,
    /// Attack by neighbours; absent: none.
    pub attack: Option<AttackConfig>,
    /// Misbehaviour detection of the ego; absent: none.
    pub trust: Option<MisbehaviourConfig>,
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
    /// [`EvaluationError`] when it cannot be read, or the protocol contradicts itself.
    pub fn open(
        &self,
        path: &Path,
        protocol: &ProtocolConfig,
    ) -> Result<OpenedData, EvaluationError> {
        let options = OpenOptions {
            intensity_scale: self.intensity_scale,
            ..OpenOptions::default()
        };
        let dataset = dataset::open_with(path, &options)?;
        let protocol = protocol
            .resolve(dataset.layout)
            .map_err(EvaluationError::Protocol)?;
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

/// Reason why an evaluation failed.
#[derive(Debug, thiserror::Error)]
pub enum EvaluationError {
    /// No ground truth for the evaluation.
    #[error(
        "scenario {scenario} has no true poses of the ego {ego}: its results cannot be evaluated"
    )]
    NoPoses {
        /// Name of the scenario.
        scenario: String,
        /// Id of its ego.
        ego: CavId,
    },
    /// The data set cannot be read.
    #[error(transparent)]
    Dataset(#[from] ReadError),
    /// The protocol is not known or contradicts itself.
    #[error("evaluation protocol: {0}")]
    Protocol(String),
    /// The data set has no frame to evaluate.
    #[error("{}: there is no frame in it that can be evaluated{reasons}", path.display())]
    Empty {
        /// The data set.
        path: PathBuf,
        /// Reasons of the frames that were left out.
        reasons: String,
    },
    /// A file cannot be hashed.
    #[error(transparent)]
    Digest(io::Error),
    /// There are no weights for a method.
    #[error(transparent)]
    Weights(#[from] WeightsChoiceError),
    /// Error of the pipeline.
    #[error(transparent)]
    Evaluate(#[from] EvaluateError),
    /// The frames' results cannot be written.
    #[error(transparent)]
    Files(#[from] FrameFilesError),
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
        let metrics = metrics(board, evaluator, clock, self.pose_source.name(), seconds);
        Metrics {
            provenance: Some(provenance.with_command()),
            ..metrics
        }
    }

    /// Identity of the result of a method: these settings, and the digests of all that they are applied to.
    ///
    /// # Errors
    /// [`EvaluationError`] names the file that cannot be read.
    pub fn key(&self, data: &OpenedData, method: Method) -> Result<CellKey, EvaluationError> {
        let provenance = self.provenance(data, method)?;
        // The contents of data and weights count, their places do not; kept maps change no result.
        let settings = Self {
            dataset: PathBuf::new(),
            weights: PathBuf::new(),
            maps: None,
            out: None,
            ..self.clone()
        };
        Ok(CellKey {
            method,
            sha256: provenance.key(&format!("{method} {settings:?}")),
            provenance,
        })
    }

    /// Digests of all that these settings are applied to.
    fn provenance(&self, data: &OpenedData, method: Method) -> Result<Provenance, EvaluationError> {
        let stepped = self.stepped.as_ref();
        let link = stepped.map(|stepped| (&stepped.link, stepped.link_folder.as_path()));
        let variant = stepped.and_then(|stepped| stepped.lidar_variant.as_deref());
        let vehicles = stepped.into_iter().flat_map(|stepped| &stepped.vehicles);
        let poses =
            std::iter::once(&self.pose_source).chain(vehicles.map(|(_, vehicle)| &vehicle.pose));
        let files = files_of(method, weights_of(&self.weights, method)?, poses, link);
        let data_sha256 = data.sha256(&self.part, variant);
        collect(&[], data_sha256, files, &data.digests).map_err(EvaluationError::Digest)
    }
}

/// Evaluates one method over the chosen scenarios, the first vehicle of each being the ego; `on_frame` is called after
/// every frame. Frames and parts that cannot be read are left out and counted in [`Metrics::left_out`].
///
/// # Errors
/// [`EvaluationError`] when no frame can be evaluated.
pub fn evaluate(
    options: &EvaluationOptions,
    data: &OpenedData,
    method: Method,
    on_frame: &mut dyn FnMut(),
) -> Result<Metrics, EvaluationError> {
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
) -> Result<Cell, EvaluationError> {
    let began = Instant::now();
    let (board, evaluator) = judged(options, data, key.method, on_frame)?;
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
) -> Result<(FrameScores, Evaluator), EvaluationError> {
    let OpenedData {
        scenarios,
        protocol,
        problems,
        ..
    } = data;
    let weights = weights_of(&options.weights, method)?;
    let mut evaluator = Evaluator::new(EvaluateConfig {
        weights: weights.clone(),
        precision: options.precision,
        method: Some(method),
        pose_source: options.pose_source.clone(),
        codec: options.codec,
        rate: options.rate,
        protocol: Some(protocol.clone()),
        delay_nanos: options.delay_nanos,
        attack: options.attack,
        trust: options.trust,
    })?;
    if let Some(kept) = options
        .maps
        .as_ref()
        .filter(|_| method.exchange() != Exchange::Points)
    {
        evaluator = evaluator.with_maps(maps(kept, &weights, options.precision, data)?);
    }
    if let Some(stepped) = &options.stepped {
        evaluator = evaluator.with_link(stepped.clone());
    }
    evaluator.add_data_set(
        problems,
        findings::sampled(scenarios, options.part.intensity_scale),
    );
    let grid = evaluator.ego().detector().config().feature_grid();
    let channels = evaluator.ego().detector().config().sent_channels();
    let map_values =
        u64::from(grid.width) * u64::from(grid.height) * u64::try_from(channels).unwrap_or(0);
    // Without a compute time, a result is as old as its sweep by definition, which is no latency.
    let is_timed = options
        .stepped
        .as_ref()
        .is_some_and(|stepped| stepped.compute != ComputeTimes::NONE);
    let mut board: Option<FrameScores> = None;
    let mut files = options
        .out
        .as_ref()
        .map(|out| FrameFiles::create(out, method))
        .transpose()?;
    for scenario in options.part.chosen(scenarios) {
        let Some(ego) = scenario.agents.first() else {
            continue;
        };
        if !scenario.has_poses(0, 0) {
            return Err(EvaluationError::NoPoses {
                scenario: scenario.name.clone(),
                ego: ego.clone(),
            });
        }
        let board = board
            .get_or_insert_with(|| FrameScores::new(ego.clone(), *evaluator.rule(), map_values));
        board.change_ego(ego);
        let judged = evaluator.run(scenario, &mut |frame| {
            let is_written = files
                .as_mut()
                .is_none_or(|files| files.add(&scenario.name, &frame));
            judge(board, frame, is_timed);
            on_frame();
            if !is_written {
                ControlFlow::Break(())
            } else {
                ControlFlow::Continue(())
            }
        })?;
        if judged.is_break() {
            break;
        }
    }
    let board = board
        .filter(|board| !board.records().is_empty())
        .ok_or_else(|| EvaluationError::Empty {
            path: options.dataset.clone(),
            reasons: evaluator.left_out().reasons(),
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
) -> Result<MapSource, EvaluationError> {
    let weights = Arc::new(
        Weights::load(weights)
            .map_err(EvaluateError::from)?
            .with_precision(precision),
    );
    let store = FeatureStore::open(
        kept,
        &weights,
        &data.scenarios,
        &data.digests,
        1,
        &mut |_, _| {},
    );
    Ok(MapSource::new(
        Arc::new(store.map_err(|error| EvaluateError::from(Box::new(error)))?),
        weights,
    ))
}
