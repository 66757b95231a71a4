//! `EXPERIMENT.yaml`: what is held fast, and the grid of what varies.

use std::ops::RangeInclusive;
use std::path::{Path, PathBuf};

use bus::config_file;
use dataset::evaluation_protocol::ProtocolConfig;
use ego_fuser::config::EgoSettings;
use ego_fuser_offline::evaluation::stepped::ComputeTimes;
use fusion::Method;
use link::LinkConfig;
use localization::pose_source::{NoiseMode, PoseSourceConfig};
use protocol::Dtype;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use super::SweepError;
use super::check;

/// An experiment.
#[derive(Debug, Clone, PartialEq, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Experiment {
    /// Name of its files: letters, digits, `-` and `_`.
    pub name: String,
    /// One line on top of the report.
    #[serde(default)]
    pub title: String,
    /// Data set, split or scenario, relative to the file; the first vehicle of each scenario is the ego.
    pub dataset: PathBuf,
    /// What to generate at `dataset` when nothing is there.
    #[serde(default)]
    pub generate: Option<Generate>,
    /// So many scenarios, evenly spread; all where absent.
    #[serde(default)]
    pub scenarios: Option<usize>,
    /// The first so many ticks of each; all where absent.
    #[serde(default)]
    pub ticks: Option<usize>,
    /// Whose messages and annotations count, and which objects.
    #[serde(default)]
    pub protocol: ProtocolConfig,
    /// Weights, or a folder with a file `*-METHOD.safetensors` for each method, relative to the file.
    pub weights: PathBuf,
    /// Where poses come from, unless the grid has pose noise.
    #[serde(default)]
    pub poses: PoseSourceConfig,
    /// How the errors of successive frames hang together, where the grid has pose noise.
    #[serde(default)]
    pub noise_mode: NoiseMode,
    /// Deadline, age and trust of the ego; which vehicle it is, `protocol.ego` says.
    #[serde(default)]
    pub ego: EgoSettings,
    /// How long everyone computes.
    #[serde(default = "no_time")]
    pub compute: ComputeTimes,
    /// The link that the grid varies: a preset of `sim-replay link`, or a file relative to this one.
    #[serde(default = "ideal")]
    pub link: String,
    /// Most gigabytes of maps that are kept per encoder, so that sweeps are encoded once for all runs.
    #[serde(default = "gigabytes")]
    pub maps_limit_gb: f64,
    /// What varies.
    pub grid: Grid,
}

/// A generated data set, see `sim-replay synth`.
#[derive(Debug, Clone, PartialEq, Eq, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Generate {
    /// Seed of routes and traffic; 1000 and above are for measuring.
    pub seed: u64,
    /// Scenarios.
    pub scenarios: usize,
    /// Frames of each.
    pub frames: usize,
    /// Fewest and most vehicles of a scenario.
    pub agents: [usize; 2],
}

impl Generate {
    /// Fewest to most vehicles.
    #[must_use]
    pub fn agents(&self) -> RangeInclusive<usize> {
        self.agents[0]..=self.agents[1]
    }
}

/// What varies: every value of each field with every value of the others. What is left out is as the link says.
#[derive(Debug, Clone, PartialEq, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Grid {
    /// Methods.
    pub method: Vec<Method>,
    /// How maps are written.
    #[serde(default)]
    pub codec: Option<Vec<CodecSpec>>,
    /// Mean delay after the last bit was sent, milliseconds.
    #[serde(default)]
    pub latency_ms: Option<Vec<f64>>,
    /// Standard deviation of that delay, milliseconds; no delay is below 0.
    #[serde(default)]
    pub jitter_ms: Option<Vec<f64>>,
    /// Rate of each link, Mbit/s; `.inf`: unlimited.
    #[serde(default)]
    pub bandwidth_mbps: Option<Vec<f64>>,
    /// Share of the messages that get lost.
    #[serde(default)]
    pub loss: Option<Vec<f64>>,
    /// Errors of the poses.
    #[serde(default)]
    pub pose_noise: Option<Vec<NoiseSpec>>,
    /// Vehicles that take part, the ego counted; all where absent.
    #[serde(default)]
    pub agents: Option<Vec<usize>>,
    /// Seeds of losses, delays and pose errors.
    #[serde(default)]
    pub seed: Option<Vec<u64>>,
}

/// How maps are written.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct CodecSpec {
    /// How exactly.
    pub dtype: Dtype,
    /// Share of the cells that are sent, those with the highest confidence; all where absent.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub keep: Option<f64>,
    /// zstd level, 1 to 22. Absent: not compressed.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub zstd_level: Option<i32>,
    /// Share of the link's rate that maps are fitted to, in coarser numbers and then with fewer cells; not fitted where absent.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub fit: Option<f64>,
}

impl Default for CodecSpec {
    fn default() -> Self {
        Self { dtype: Dtype::F16, keep: None, zstd_level: None, fit: None }
    }
}

impl CodecSpec {
    /// What tables and charts call it: its numbers, and the share of the link that maps are fitted to.
    #[must_use]
    pub fn name(&self) -> String {
        let fitted = self.fit.map_or(String::new(), |share| format!(" fitted to {share}"));
        format!("{:?}{fitted}", self.dtype).to_lowercase()
    }
}

/// Standard deviations of a pose's error.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct NoiseSpec {
    /// Of the position along each axis, metres.
    pub position_std_m: f64,
    /// Of the heading, degrees.
    pub heading_std_deg: f64,
}

fn no_time() -> ComputeTimes {
    ComputeTimes::NONE
}

fn ideal() -> String {
    "ideal".into()
}

fn gigabytes() -> f64 {
    6.0
}

impl Experiment {
    /// Reads and checks an experiment. Relative paths in it are taken from its folder, but for files of `poses`, which
    /// go by the working directory as on the command line.
    ///
    /// # Errors
    /// [`SweepError`] names the file and the field.
    pub fn read(path: &Path) -> Result<Self, SweepError> {
        let spec = |problem: String| SweepError::Spec { path: path.into(), problem };
        let mut experiment: Self = config_file::read(path)?;
        let folder = path.parent().unwrap_or(Path::new("."));
        experiment.dataset = folder.join(&experiment.dataset);
        experiment.weights = folder.join(&experiment.weights);
        let is_preset = LinkConfig::preset(&experiment.link).is_ok();
        if !is_preset {
            experiment.link = folder.join(&experiment.link).to_string_lossy().into_owned();
        }
        check::check(&experiment).map_err(spec)?;
        Ok(experiment)
    }

    /// The part of the data set that is looked at.
    #[must_use]
    pub fn part(&self) -> crate::experiment::evaluation::Part {
        crate::experiment::evaluation::Part { scenarios: self.scenarios, ticks: self.ticks, ..Default::default() }
    }
}
