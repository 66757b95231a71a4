//! A method on recorded scenes without a network: the numbers of a run in which nothing is late, or of one whose messages
//! cross the emulated air in virtual time.

use std::ops::ControlFlow;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Instant;

use agent::attack::AttackConfig;
use agent::rate::RateConfig;
use dataset::evaluation_protocol::{EvaluationProtocol, ProtocolConfig};
use dataset::{self, IntensityScale, OpenOptions, ReadError, Scenario};
use ego_fuser::misbehaviour::MisbehaviourConfig;
use ego_fuser_offline::evaluation::stepped::{ComputeTimes, SteppedConfig};
use ego_fuser_offline::evaluation::{EvaluateConfig, EvaluateError, EvaluatedFrame, Evaluator};
use fusion::Exchange;
use fusion::Method;
use localization::pose_source::PoseSourceConfig;
use perception::weights::Weights;
use protocol::{CavId, CodecConfig};
use training::feature_store::{FeatureStore, KeptMaps, MapSource};

use crate::experiment::metrics::Metrics;
use crate::experiment::score::FrameScores;
use crate::experiment::weights_choice::{WeightsChoiceError, weights_of};

/// What to evaluate.
#[derive(Debug, Clone, Default)]
pub struct EvaluationOptions {
    /// Data set, split or scenario.
    pub dataset: PathBuf,
    /// Weights of the detector, or a folder that holds a file `<name>-<method>.safetensors` for each method.
    pub weights: PathBuf,
    /// Where the vehicles' poses come from.
    pub pose_source: PoseSourceConfig,
    /// How feature maps are written.
    pub codec: CodecConfig,
    /// How neighbours fit them to what the air takes.
    pub rate: RateConfig,
    /// How long messages of neighbours are under way, nanoseconds.
    pub delay_nanos: u64,
    /// Neighbours that lie; absent: none.
    pub attack: Option<AttackConfig>,
    /// Whether the ego leaves out neighbours that it does not trust, and when.
    pub trust: Option<MisbehaviourConfig>,
    /// Where maps of encoders are kept, so that each is computed once for many evaluations.
    pub maps: Option<KeptMaps>,
    /// Frames to judge at most, over all scenarios.
    pub frames: Option<usize>,
    /// The air that messages cross, in virtual time; absent: none.
    pub stepped: Option<SteppedConfig>,
    /// The part of the data set that is judged.
    pub part: Part,
    /// Whose messages and annotations count, and which objects.
    pub protocol: ProtocolConfig,
}

/// A data set, opened to be judged by a protocol.
#[derive(Debug)]
pub struct OpenedData {
    /// The scenarios, with the agents that take part.
    pub scenarios: Vec<Scenario>,
    /// The protocol.
    pub protocol: EvaluationProtocol,
    /// Parts of the data set that are not used.
    pub problems: Vec<ReadError>,
}

/// A part of a data set.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Part {
    /// So many scenarios, evenly spread; all where absent.
    pub scenarios: Option<usize>,
    /// The first so many ticks of each; all where absent.
    pub ticks: Option<usize>,
    /// Divisor of the intensities of its sweeps.
    pub intensity_scale: IntensityScale,
}

impl Part {
    /// Opens a data set: all its scenarios, each with the agents of the protocol and the ticks that are asked for. Maps are
    /// kept of these, so that another choice among them needs no others.
    ///
    /// # Errors
    /// [`EvaluationError`] when it cannot be read, or the protocol contradicts itself.
    pub fn open(&self, path: &Path, protocol: &ProtocolConfig) -> Result<OpenedData, EvaluationError> {
        let options = OpenOptions { intensity_scale: self.intensity_scale, ..OpenOptions::default() };
        let dataset = dataset::open_with(path, &options)?;
        let protocol = protocol.resolve(dataset.layout).map_err(EvaluationError::Protocol)?;
        let mut scenarios: Vec<Scenario> =
            dataset.scenarios.iter().filter_map(|scenario| protocol.arrange(scenario)).collect();
        scenarios.iter_mut().for_each(|scenario| scenario.ticks.truncate(self.ticks.unwrap_or(usize::MAX)));
        Ok(OpenedData { scenarios, protocol, problems: dataset.problems })
    }

    /// Those of all scenarios that are asked for.
    pub fn chosen<'a>(&self, scenarios: &'a [Scenario]) -> impl Iterator<Item = &'a Scenario> {
        let count = self.scenarios.map_or(scenarios.len(), |most| most.min(scenarios.len()));
        (0..count).map(move |index| &scenarios[index * scenarios.len() / count])
    }
}

/// Why an evaluation came to nothing.
#[derive(Debug, thiserror::Error)]
pub enum EvaluationError {
    /// There is no truth to judge by.
    #[error("scenario {scenario} has no true poses of the ego {ego}: there is nothing to judge its results by")]
    NoPoses {
        /// The scenario.
        scenario: String,
        /// Its ego.
        ego: CavId,
    },
    /// The data set cannot be read.
    #[error(transparent)]
    Dataset(#[from] ReadError),
    /// The protocol is not known or contradicts itself.
    #[error("evaluation protocol: {0}")]
    Protocol(String),
    /// The data set has no frame to judge.
    #[error("{}: there is no frame in it", .0.display())]
    Empty(PathBuf),
    /// There are no weights for a method.
    #[error(transparent)]
    Weights(#[from] WeightsChoiceError),
    /// The pipeline refused.
    #[error(transparent)]
    Evaluate(#[from] EvaluateError),
}

/// Frames there are to judge in a data set, over all scenarios.
///
/// # Errors
/// [`EvaluationError`] when the data set cannot be read.
pub fn frame_count(options: &EvaluationOptions) -> Result<usize, EvaluationError> {
    let scenarios = options.part.open(&options.dataset, &options.protocol)?.scenarios;
    let ticks = options.part.chosen(&scenarios).map(|scenario| scenario.ticks.len()).sum();
    Ok(options.frames.map_or(ticks, |frames| frames.min(ticks)))
}

/// RunScope one method over all scenarios, the first vehicle of each being the ego; `on_frame` is told of every frame. Frames
/// and parts that cannot be read are left out and counted in [`Metrics::left_out`].
///
/// # Errors
/// [`EvaluationError`] when the data set cannot be opened, and when no frame can be judged.
pub fn evaluate(
    options: &EvaluationOptions,
    method: Method,
    on_frame: &mut dyn FnMut(),
) -> Result<Metrics, EvaluationError> {
    let (board, evaluator, began) = judged(options, method, on_frame)?;
    Ok(metrics(&board, &evaluator, options, began))
}

/// The same with the board itself, for those who want to know more than the numbers.
///
/// # Errors
/// As [`evaluate`].
pub(crate) fn judged(
    options: &EvaluationOptions,
    method: Method,
    on_frame: &mut dyn FnMut(),
) -> Result<(FrameScores, Evaluator, Instant), EvaluationError> {
    let began = Instant::now();
    let OpenedData { scenarios, protocol, problems } = options.part.open(&options.dataset, &options.protocol)?;
    let weights = weights_of(&options.weights, method)?;
    let mut evaluator = Evaluator::new(EvaluateConfig {
        weights: weights.clone(),
        method: Some(method),
        pose_source: options.pose_source.clone(),
        codec: options.codec,
        rate: options.rate,
        protocol: Some(protocol.clone()),
        delay_nanos: options.delay_nanos,
        attack: options.attack,
        trust: options.trust,
    })?;
    if let Some(kept) = options.maps.as_ref().filter(|_| method.exchange() != Exchange::Points) {
        evaluator = evaluator.with_maps(maps(kept, &weights, &scenarios)?);
    }
    if let Some(stepped) = &options.stepped {
        evaluator = evaluator.with_link(stepped.clone());
    }
    evaluator.add_left_out_files(&problems);
    let grid = evaluator.ego().detector().config().feature_grid();
    let channels = evaluator.ego().detector().config().sent_channels();
    let map_values = u64::from(grid.width) * u64::from(grid.height) * u64::try_from(channels).unwrap_or(0);
    let left = options.frames.unwrap_or(usize::MAX);
    // Without a time to compute, a result is as old as its sweep by definition: that is no latency.
    let is_timed = options.stepped.as_ref().is_some_and(|stepped| stepped.compute != ComputeTimes::NONE);
    let mut board: Option<FrameScores> = None;
    for scenario in options.part.chosen(&scenarios) {
        let Some(ego) = scenario.agents.first() else { continue };
        if !scenario.has_poses(0, 0) {
            return Err(EvaluationError::NoPoses { scenario: scenario.name.clone(), ego: ego.clone() });
        }
        let board = board.get_or_insert_with(|| FrameScores::new(ego.clone(), *evaluator.rule(), map_values));
        board.change_ego(ego);
        let judged = evaluator.run(scenario, &mut |frame| {
            judge(board, frame, is_timed);
            on_frame();
            if board.records().len() >= left { ControlFlow::Break(()) } else { ControlFlow::Continue(()) }
        })?;
        if judged.is_break() {
            break;
        }
    }
    let board =
        board.filter(|board| !board.records().is_empty()).ok_or(EvaluationError::Empty(options.dataset.clone()))?;
    Ok((board, evaluator, began))
}

/// The maps of all sweeps, encoded now where they have not been before.
fn maps(kept: &KeptMaps, weights: &Path, scenarios: &[Scenario]) -> Result<MapSource, EvaluationError> {
    let weights = Arc::new(Weights::load(weights).map_err(EvaluateError::from)?);
    let store = FeatureStore::open(kept, &weights, scenarios, &mut |_, _| {});
    Ok(MapSource::new(Arc::new(store.map_err(|error| EvaluateError::from(Box::new(error)))?), weights))
}

/// Judges a frame; where computers take a time its stamp says when it was published.
pub(crate) fn judge(board: &mut FrameScores, frame: EvaluatedFrame, is_timed: bool) {
    let EvaluatedFrame { tick, stamp, result, frames, poses, objects } = frame;
    let poses: Vec<_> = frames.iter().map(|frame| frame.cav.clone()).zip(poses).collect();
    let truth: Vec<(CavId, _)> =
        frames.iter().filter_map(|frame| Some((frame.cav.clone(), frame.world_from_lidar?))).collect();
    let latency_ms = is_timed.then(|| (stamp.publish_nanos - stamp.capture_nanos) as f64 / 1e6);
    board.judge_whole((tick as u64, stamp.capture_nanos), latency_ms, result, objects, &poses, truth);
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
    let metrics = Metrics::of(board, clock, names, seconds, evaluator.ledger(), Some(evaluator.sent_bytes()));
    Metrics { left_out: evaluator.left_out().clone(), protocol: evaluator.protocol(), ..metrics }
}
