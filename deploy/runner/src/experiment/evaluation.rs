//! Offline evaluation of a method on recorded scenes: without delays, or with link emulation in simulation time.

use std::ops::ControlFlow;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Instant;

use agent::attack::AttackConfig;
use agent::rate::RateConfig;
use dataset::evaluation_protocol::{EvaluationProtocol, ProtocolConfig};
use dataset::{self, IntensityScale, OpenOptions, ReadError, Scenario};
use deploy::score::FrameScores;
use deploy::score::metrics::Metrics;
use ego_fuser::misbehaviour::MisbehaviourConfig;
use ego_fuser_offline::evaluation::stepped::{ComputeTimes, SteppedConfig};
use ego_fuser_offline::evaluation::{EvaluateConfig, EvaluateError, Evaluator};
use fusion::Exchange;
use fusion::Method;
use localization::pose_source::PoseSourceConfig;
use perception::int8::InferencePrecision;
use perception::weights::Weights;
use protocol::{CavId, CodecConfig};
use training::feature_store::{FeatureStore, KeptMaps, MapSource};

use crate::evaluated_frame::judge;
use crate::experiment::frame_files::{FrameFiles, FrameFilesError};
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
    /// Largest number of frames to evaluate, over all scenarios.
    pub frames: Option<usize>,
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
}

/// A part of a data set.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Part {
    /// Number of scenarios, evenly spread; absent: all.
    pub scenarios: Option<usize>,
    /// Number of ticks from the start of each scenario; absent: all.
    pub ticks: Option<usize>,
    /// Divisor of the intensities of its sweeps.
    pub intensity_scale: IntensityScale,
}

impl Part {
    /// Opens a data set: all its scenarios, each with the agents of the protocol and the requested ticks. Feature maps
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
            .for_each(|scenario| scenario.ticks.truncate(self.ticks.unwrap_or(usize::MAX)));
        Ok(OpenedData {
            scenarios,
            protocol,
            problems: dataset.problems,
        })
    }

    /// The requested scenarios.
    pub fn chosen<'a>(&self, scenarios: &'a [Scenario]) -> impl Iterator<Item = &'a Scenario> {
        let count = self
            .scenarios
            .map_or(scenarios.len(), |most| most.min(scenarios.len()));
        (0..count).map(move |index| &scenarios[index * scenarios.len() / count])
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
    #[error("{}: there is no frame in it", .0.display())]
    Empty(PathBuf),
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

/// Number of frames to evaluate in a data set, over all scenarios.
///
/// # Errors
/// [`EvaluationError`] when the data set cannot be read.
pub fn frame_count(options: &EvaluationOptions) -> Result<usize, EvaluationError> {
    let scenarios = options
        .part
        .open(&options.dataset, &options.protocol)?
        .scenarios;
    let ticks = options
        .part
        .chosen(&scenarios)
        .map(|scenario| scenario.ticks.len())
        .sum();
    Ok(options.frames.map_or(ticks, |frames| frames.min(ticks)))
}

/// Evaluates one method over all scenarios, the first vehicle of each being the ego; `on_frame` is called after every
/// frame. Frames and parts that cannot be read are left out and counted in [`Metrics::left_out`].
///
/// # Errors
/// [`EvaluationError`] when the data set cannot be opened, and when no frame can be evaluated.
pub fn evaluate(
    options: &EvaluationOptions,
    method: Method,
    on_frame: &mut dyn FnMut(),
) -> Result<Metrics, EvaluationError> {
    let (board, evaluator, began) = judged(options, method, on_frame)?;
    Ok(metrics(&board, &evaluator, options, began))
}

/// Like [`evaluate`], but returns the scores of all frames in addition to the metrics.
///
/// # Errors
/// As [`evaluate`].
pub(crate) fn judged(
    options: &EvaluationOptions,
    method: Method,
    on_frame: &mut dyn FnMut(),
) -> Result<(FrameScores, Evaluator, Instant), EvaluationError> {
    let began = Instant::now();
    let OpenedData {
        scenarios,
        protocol,
        problems,
    } = options.part.open(&options.dataset, &options.protocol)?;
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
        evaluator = evaluator.with_maps(maps(kept, &weights, options.precision, &scenarios)?);
    }
    if let Some(stepped) = &options.stepped {
        evaluator = evaluator.with_link(stepped.clone());
    }
    evaluator.add_left_out_files(&problems);
    let grid = evaluator.ego().detector().config().feature_grid();
    let channels = evaluator.ego().detector().config().sent_channels();
    let map_values =
        u64::from(grid.width) * u64::from(grid.height) * u64::try_from(channels).unwrap_or(0);
    let left = options.frames.unwrap_or(usize::MAX);
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
    for scenario in options.part.chosen(&scenarios) {
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
            if board.records().len() >= left || !is_written {
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
        .ok_or(EvaluationError::Empty(options.dataset.clone()))?;
    files.map(|files| files.finish(&board)).transpose()?;
    Ok((board, evaluator, began))
}

/// Feature maps of all sweeps, from the cache or encoded now.
fn maps(
    kept: &KeptMaps,
    weights: &Path,
    precision: InferencePrecision,
    scenarios: &[Scenario],
) -> Result<MapSource, EvaluationError> {
    let weights = Arc::new(
        Weights::load(weights)
            .map_err(EvaluateError::from)?
            .with_precision(precision),
    );
    let store = FeatureStore::open(kept, &weights, scenarios, 1, &mut |_, _| {});
    Ok(MapSource::new(
        Arc::new(store.map_err(|error| EvaluateError::from(Box::new(error)))?),
        weights,
    ))
}

pub(crate) fn metrics(
    board: &FrameScores,
    evaluator: &Evaluator,
    options: &EvaluationOptions,
    began: Instant,
) -> Metrics {
    let (clock, seconds) = match options.stepped {
        Some(_) => ("stepped", board.seconds()),
        None => ("offline", began.elapsed().as_secs_f64()),
    };
    let names = [evaluator.ego().method().name(), options.pose_source.name()];
    let metrics = Metrics::of(
        board,
        clock,
        names,
        seconds,
        evaluator.ledger(),
        Some(evaluator.sent_bytes()),
    );
    Metrics {
        left_out: evaluator.left_out().clone(),
        protocol: evaluator.protocol(),
        ..metrics
    }
}
