//! Inspection of a data set: contents and problems.
//!
//! Every frame is read. A frame that cannot be read becomes a [`Problem`] with file, line and field, and reading
//! continues.

mod map;
mod survey;
mod table;

use protocol::{CavId, Handedness};
use serde::Serialize;

pub use map::{MapReport, inspect_map};
pub use survey::inspect;

pub use dataset::Problem;
use dataset::evaluation_protocol::EvaluationProtocol;
pub use dataset::findings::SweepReport;
use dataset::{Layout, MissingFrame};

/// The findings. Serializes to the JSON of `sim-replay inspect --json`, prints as its table.
#[derive(Debug, Clone, Default, Serialize)]
pub struct Report {
    /// The folder, as given.
    pub path: String,
    /// Its layout, if it is a supported one.
    pub layout: Option<Layout>,
    /// The protocol by which ground truth was merged: that of the layout, unless another was requested.
    pub protocol: Option<EvaluationProtocol>,
    /// Findings of each scenario.
    pub scenarios: Vec<ScenarioReport>,
    /// Merged ground truth by tick, ego and set of agents: ego-only, and with all agents in range.
    pub ticks: Vec<TickReport>,
    /// Faults of the data set.
    pub problems: Vec<Problem>,
}

/// A scenario.
#[derive(Debug, Clone, Serialize)]
pub struct ScenarioReport {
    /// Its name.
    pub name: String,
    /// Its layout.
    pub layout: Layout,
    /// Handedness of its axes on disk.
    pub handedness: Handedness,
    /// Number of ticks of the ego.
    pub frames: usize,
    /// Time from the first tick to the last, seconds.
    pub seconds: f64,
    /// Frames per second, by the median step; `None` for a single frame.
    pub rate_hz: Option<f64>,
    /// Its agents, ego first.
    pub agents: Vec<AgentReport>,
    /// Variants of the LiDAR sweep.
    pub lidar_variants: Vec<String>,
    /// True if there are radar points.
    pub has_radar: bool,
    /// Numbers of the cameras that have images.
    pub cameras: Vec<u8>,
    /// Frames that some agents have and others lack.
    pub missing: Vec<MissingFrame>,
    /// Lists of files that were joined, and by which property.
    pub joins: Vec<String>,
}

/// An agent of a scenario.
#[derive(Debug, Clone, Serialize)]
pub struct AgentReport {
    /// Id of the agent.
    pub id: CavId,
    /// Ticks at which it has a readable sweep.
    pub frames: usize,
    /// Points of a sweep.
    pub points: Option<CountSummary>,
    /// Form and intensities of its sweeps; `None` if none has a point.
    pub sweeps: Option<SweepReport>,
    /// Points left out because a number is not finite, over all sweeps. Organised clouds have many.
    pub dropped_points: usize,
    /// Radar points of a frame.
    pub radar_points: Option<CountSummary>,
    /// Annotated objects of a frame.
    pub boxes: Option<CountSummary>,
    /// Boxes that hold none of the agent's own points, over all frames. Many of them hint at wrong axes.
    pub boxes_without_points: usize,
    /// Path length of the LiDAR, metres, over all frames with a pose; `None` without poses.
    pub distance_m: Option<f64>,
}

/// Smallest, mean and largest of a count per frame.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct CountSummary {
    /// Smallest.
    pub min: usize,
    /// Mean.
    pub mean: f64,
    /// Largest.
    pub max: usize,
}

impl CountSummary {
    /// Summary of counts, one per frame; `None` if there is none.
    pub fn of(counts: &[usize]) -> Option<Self> {
        let (min, max) = (*counts.iter().min()?, *counts.iter().max()?);
        Some(Self {
            min,
            mean: counts.iter().sum::<usize>() as f64 / counts.len() as f64,
            max,
        })
    }
}

/// Merged ground truth of one tick for one ego and one set of agents.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct TickReport {
    /// Scenario.
    pub scenario: String,
    /// Index of the tick in the scenario, as `--seek` takes it.
    pub tick: usize,
    /// Stem of its files.
    pub stem: String,
    /// Agent whose LiDAR frame and range apply.
    pub ego: CavId,
    /// Agents whose annotations were merged, the ego first.
    pub agents: Vec<CavId>,
    /// Number of objects.
    pub merged_boxes: usize,
}
