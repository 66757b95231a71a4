//! What a dataset holds, and everything that is wrong with it.
//!
//! Every frame is read. What cannot be read becomes a [`Problem`] with file, line and field, and the rest goes on.

mod boxes;
mod cells;
mod map;
mod survey;
mod sweeps;
mod table;

use protocol::{CavId, Handedness};
use serde::Serialize;

pub use map::{MapReport, inspect_map};
pub use survey::inspect;
pub use sweeps::SweepReport;

pub use dataset::Problem;
use dataset::evaluation_protocol::EvaluationProtocol;
use dataset::{Layout, MissingFrame};

/// The findings. Serializes to the JSON of `sim-replay inspect --json`, prints as its table.
#[derive(Debug, Clone, Serialize)]
pub struct Report {
    /// The folder, as it was given.
    pub path: String,
    /// Its layout, where it has one that is known.
    pub layout: Option<Layout>,
    /// The protocol that ground truth was merged by: the one of the layout, unless another was asked for.
    pub protocol: Option<EvaluationProtocol>,
    /// What was found in each scenario.
    pub scenarios: Vec<ScenarioReport>,
    /// Merged ground truth by tick, ego and set of agents: the ego alone, and with all in range.
    pub ticks: Vec<TickReport>,
    /// What is wrong.
    pub problems: Vec<Problem>,
}

/// A scenario.
#[derive(Debug, Clone, Serialize)]
pub struct ScenarioReport {
    /// Its name.
    pub name: String,
    /// Its layout.
    pub layout: Layout,
    /// Which way its axes turn on disk.
    pub handedness: Handedness,
    /// Moments of the ego.
    pub frames: usize,
    /// From the first moment to the last, seconds.
    pub seconds: f64,
    /// Frames per second, by the median step; `None` for a single frame.
    pub rate_hz: Option<f64>,
    /// Its agents, ego first.
    pub agents: Vec<AgentReport>,
    /// Variants of the LiDAR sweep.
    pub lidar_variants: Vec<String>,
    /// Whether there are radar points.
    pub has_radar: bool,
    /// Frames that some agents have and others lack.
    pub missing: Vec<MissingFrame>,
}

/// An agent of a scenario.
#[derive(Debug, Clone, Serialize)]
pub struct AgentReport {
    /// Who.
    pub id: CavId,
    /// Moments at which it has a sweep that can be read.
    pub frames: usize,
    /// Points of a sweep.
    pub points: Option<Summary>,
    /// Form and intensities of its sweeps; `None` where none has a point.
    pub sweeps: Option<SweepReport>,
    /// Points left out because a number is not finite, over all sweeps. Organised clouds have many.
    pub dropped_points: usize,
    /// Radar points of a frame.
    pub radar_points: Option<Summary>,
    /// Annotated objects of a frame.
    pub boxes: Option<Summary>,
    /// Boxes that hold none of the agent's own points, over all frames. Many of them hint at wrong axes.
    pub boxes_without_points: usize,
    /// How far the LiDAR moved, metres, over all frames with a pose; `None` without poses.
    pub distance_m: Option<f64>,
}

/// Smallest, mean and largest of a count per frame.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Summary {
    /// Smallest.
    pub min: usize,
    /// Mean.
    pub mean: f64,
    /// Largest.
    pub max: usize,
}

impl Summary {
    /// Of counts, one per frame; `None` where there is none.
    #[must_use]
    pub fn of(counts: &[usize]) -> Option<Self> {
        let (min, max) = (*counts.iter().min()?, *counts.iter().max()?);
        Some(Self { min, mean: counts.iter().sum::<usize>() as f64 / counts.len() as f64, max })
    }
}

/// Merged ground truth of one tick for one ego and one set of agents.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct TickReport {
    /// Scenario.
    pub scenario: String,
    /// Stem of the tick.
    pub tick: String,
    /// In whose LiDAR frame and range.
    pub ego: CavId,
    /// Whose annotations were merged, the ego first.
    pub agents: Vec<CavId>,
    /// How many objects there are.
    pub merged_boxes: usize,
}
