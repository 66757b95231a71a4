//! Data sets that were opened, written in another layout.

use std::collections::BTreeMap;
use std::path::PathBuf;
use std::sync::Mutex;
use std::sync::atomic::{AtomicUsize, Ordering};

use rayon::prelude::*;

use super::error::SynthError;
use super::generate::check_folder;
use super::layout::{
    AgentFrame, LeftOut, Moment, SceneAgent, SceneHeader, SceneLayout, SceneWriter, SweepVariant, Unfinished,
};
use super::protocol_file::converted_yaml;
use crate::dataset::{Dataset, LoadOptions, ReadError, Scenario};

/// Lengths of a tick that are tried, nanoseconds: a simulator's step, and what clocks of sensors are read to.
const TICKS_NANOS: [u64; 4] = [50_000_000, 10_000_000, 1_000_000, 1_000];

/// What to write, and where.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ConvertOptions {
    /// Where the scenarios go.
    pub out: PathBuf,
    /// Layout of the files.
    pub layout: SceneLayout,
    /// Whether to write into a folder that holds something already.
    pub force: bool,
}

/// What was converted.
#[derive(Debug, Default)]
pub struct Converted {
    /// Scenarios.
    pub scenarios: usize,
    /// Frames of all agents together.
    pub agent_frames: usize,
    /// What the layout has no place for, and how often it was left out.
    pub left_out: BTreeMap<&'static str, u64>,
    /// Frames that could not be read and are left out.
    pub problems: Vec<ReadError>,
}

/// Writes all scenarios of a data set in a layout. `progress` hears how many moments are done and how many there are.
///
/// # Errors
/// [`SynthError`] where the layout cannot hold a scene or a file cannot be written. A frame that cannot be read is left out
/// and stands in [`Converted::problems`].
pub fn convert(
    dataset: &Dataset,
    options: &ConvertOptions,
    progress: &(dyn Fn(usize, usize) + Sync),
) -> Result<Converted, SynthError> {
    check_folder(&options.out, options.force)?;
    let unfinished = Unfinished::mark(&options.out)?;
    let mut writer = options.layout.writer(&options.out);
    let (left_out, problems) = (LeftOut::default(), Mutex::new(Vec::new()));
    let mut converted = Converted::default();
    let total = dataset.scenarios.iter().map(|scenario| scenario.ticks.len()).sum();
    let done = AtomicUsize::new(0);
    for scenario in &dataset.scenarios {
        writer.begin(&header(scenario, dataset)?)?;
        let frames = write_moments(scenario, writer.as_ref(), (&left_out, &problems), &|| {
            progress(done.fetch_add(1, Ordering::Relaxed) + 1, total);
        })?;
        writer.end()?;
        converted.scenarios += 1;
        converted.agent_frames += frames;
    }
    writer.finish()?;
    unfinished.clear()?;
    converted.left_out = left_out.into_counts();
    converted.problems = problems.into_inner().unwrap_or_else(std::sync::PoisonError::into_inner);
    converted.problems.sort_by_key(ToString::to_string);
    Ok(converted)
}

fn header(scenario: &Scenario, dataset: &Dataset) -> Result<SceneHeader, SynthError> {
    let capture_nanos: Vec<u64> = scenario.ticks.iter().map(|tick| tick.capture_nanos).collect();
    let divides = |tick: &u64| capture_nanos.iter().all(|nanos| nanos % tick == 0);
    let tick_nanos = TICKS_NANOS.into_iter().find(divides).unwrap_or(TICKS_NANOS[TICKS_NANOS.len() - 1]);
    if let Some(pair) = capture_nanos.windows(2).find(|pair| pair[0] / tick_nanos >= pair[1] / tick_nanos) {
        let reason =
            format!("scenario {}: two moments at {} and {} ns: times do not rise", scenario.name, pair[0], pair[1]);
        return Err(SynthError::Layout { layout: "of the input", reason });
    }
    let from = format!("{:?}", dataset.layout);
    let agents = scenario.agents.iter().map(|id| SceneAgent { id: id.clone(), is_roadside: is_roadside(id.as_str()) });
    Ok(SceneHeader {
        name: scenario.name.clone(),
        agents: agents.collect(),
        origin: converted_yaml(&from, &scenario.name, tick_nanos),
        capture_nanos,
        tick_nanos,
    })
}

/// Units at the roadside have negative numbers in the OPV2V family.
fn is_roadside(id: &str) -> bool {
    id.starts_with('-')
}

/// Writes the moments at which the ego is present; returns how many frames.
fn write_moments(
    scenario: &Scenario,
    writer: &dyn SceneWriter,
    (left_out, problems): (&LeftOut, &Mutex<Vec<ReadError>>),
    done: &(dyn Fn() + Sync),
) -> Result<usize, SynthError> {
    let moments = (0..scenario.ticks.len()).into_par_iter().map(|index| {
        let moment = read_moment(scenario, index, problems);
        let frames = moment.frames.len();
        if frames > 0 {
            writer.write(&moment, left_out)?;
        }
        done();
        Ok(frames)
    });
    moments.sum()
}

/// Reads all agents' frames of a moment. Without the ego's there is none.
fn read_moment(scenario: &Scenario, index: usize, problems: &Mutex<Vec<ReadError>>) -> Moment {
    let mut frames = Vec::with_capacity(scenario.agents.len());
    for agent in 0..scenario.agents.len() {
        match read_frame(scenario, agent, index) {
            Ok(frame) => frames.push(frame),
            Err(error) => {
                problems.lock().unwrap_or_else(std::sync::PoisonError::into_inner).push(error);
                if agent == 0 {
                    break;
                }
            }
        }
    }
    Moment { index, frames }
}

fn read_frame(scenario: &Scenario, agent: usize, index: usize) -> Result<AgentFrame, ReadError> {
    let frame = scenario.load(agent, index, &LoadOptions { lidar_variant: None, points: true, radar: true })?;
    if frame.world_from_lidar.is_none() {
        let path = scenario.points_path(agent, index, None)?;
        return Err(ReadError::malformed(&path, "there is no pose for this sweep"));
    }
    let variants = scenario.lidar_variants.iter().map(|name| {
        let cloud = scenario.load_points(agent, index, Some(name))?;
        let labels = cloud.labels.unwrap_or_else(|| vec![0; cloud.points.len()]);
        Ok(SweepVariant { name: name.clone(), points: cloud.points.xyzi, labels })
    });
    let variants = variants.collect::<Result<_, ReadError>>()?;
    Ok(AgentFrame { agent, frame, variants, simulated: None })
}
