//! `EXPERIMENT.yaml`: fixed settings, and the grid of the varied ones.

use std::ops::RangeInclusive;
use std::path::{Path, PathBuf};

use bus::config_file;
use dataset::evaluation_protocol::ProtocolConfig;
use ego_fuser::config::EgoSettings;
use ego_fuser_offline::evaluation::stepped::ComputeTimes;
use fusion::Method;
use link::LinkConfig;
use localization::pose_source::{NoiseMode, PoseSourceConfig};
use perception::int8::InferencePrecision;
use protocol::Dtype;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use support::file_error::FileError;

use super::check;
use crate::experiment::evaluation::Part;

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
    /// Settings of the generator for a `dataset` that does not exist.
    #[serde(default)]
    pub generate: Option<Generate>,
    /// Number of scenarios, evenly spread; absent: all.
    #[serde(default)]
    pub scenarios: Option<usize>,
    /// Largest number of frames of each scenario; absent: all.
    #[serde(default)]
    pub frames: Option<usize>,
    /// Participating vehicles, counted annotations and objects.
    #[serde(default)]
    pub protocol: ProtocolConfig,
    /// Weights, or a folder with a file `*-METHOD.safetensors` for each method, relative to the file.
    pub weights: PathBuf,
    /// Number format in which networks are computed.
    #[serde(default)]
    pub precision: InferencePrecision,
    /// Pose source, unless the grid has pose noise.
    #[serde(default)]
    pub poses: PoseSourceConfig,
    /// Correlation of the errors of successive frames, if the grid has pose noise.
    #[serde(default)]
    pub noise_mode: NoiseMode,
    /// Deadline, age and trust of the ego; `protocol.ego_kind` selects the vehicle.
    #[serde(default)]
    pub ego: EgoSettings,
    /// Compute times of the stages.
    #[serde(default = "no_time")]
    pub compute: ComputeTimes,
    /// The link that the grid varies: a preset of `sim-replay link`, or a file relative to this one.
    #[serde(default = "ideal")]
    pub link: String,
    /// Largest cache of feature maps per encoder, gigabytes, so that sweeps are encoded once for all runs.
    #[serde(default = "gigabytes")]
    pub feature_maps_limit_gb: f64,
    /// Axes that vary.
    pub grid: Grid,
}

/// A generated data set, see `sim-replay synth`.
#[derive(Debug, Clone, PartialEq, Eq, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Generate {
    /// Seed of routes and traffic; 1000 and above are for measuring.
    pub seed: u64,
    /// Number of scenarios.
    pub scenes: usize,
    /// Number of frames of each.
    pub frames: usize,
    /// Smallest and largest number of vehicles of a scenario.
    pub vehicles: [usize; 2],
}

impl Generate {
    /// Smallest to largest number of vehicles.
    #[must_use]
    pub fn vehicles(&self) -> RangeInclusive<usize> {
        self.vehicles[0]..=self.vehicles[1]
    }
}

/// Axes of the grid: every value of each field with every value of the others. An absent axis is as in the link.
#[derive(Debug, Clone, PartialEq, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Grid {
    /// Fusion methods.
    pub method: Vec<Method>,
    /// Encodings of feature maps.
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
    /// Fraction of the messages that are lost.
    #[serde(default)]
    pub loss: Option<Vec<f64>>,
    /// Errors of the poses.
    #[serde(default)]
    pub pose_noise: Option<Vec<NoiseSpec>>,
    /// Number of participating vehicles, the ego included; absent: all.
    #[serde(default)]
    pub vehicles: Option<Vec<usize>>,
    /// Seeds of losses, delays and pose errors.
    #[serde(default)]
    pub seed: Option<Vec<u64>>,
}

/// Encoding of feature maps.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct CodecSpec {
    /// Number format of the values.
    pub dtype: Dtype,
    /// Fraction of the cells that are sent, those with the highest confidence; absent: all.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub keep: Option<f64>,
    /// zstd level, 1 to 22. Absent: not compressed.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub zstd_level: Option<i32>,
    /// Fraction of the link's rate that feature maps are adapted to, by coarser numbers and then fewer cells; absent:
    /// not adapted.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub fit: Option<f64>,
}

impl Default for CodecSpec {
    fn default() -> Self {
        Self {
            dtype: Dtype::F16,
            keep: None,
            zstd_level: None,
            fit: None,
        }
    }
}

impl CodecSpec {
    /// Label in tables and charts: the number format, and the fraction of the link's rate.
    #[must_use]
    pub fn name(&self) -> String {
        let fitted = self
            .fit
            .map_or(String::new(), |share| format!(" fitted to {share}"));
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
    /// Reads and checks an experiment. Relative paths are resolved against its folder, except for files of `poses`,
    /// which are resolved against the working directory as on the command line.
    ///
    /// # Errors
    /// [`FileError`] names the file and the field.
    pub fn read(path: &Path) -> Result<Self, FileError> {
        let mut experiment: Self = config_file::read(path)?;
        let folder = path.parent().unwrap_or(Path::new("."));
        experiment.dataset = folder.join(&experiment.dataset);
        experiment.weights = folder.join(&experiment.weights);
        let is_preset = LinkConfig::preset(&experiment.link).is_ok();
        if !is_preset {
            experiment.link = folder.join(&experiment.link).to_string_lossy().into_owned();
        }
        let poses = std::mem::take(&mut experiment.poses).with_networks();
        experiment.poses =
            poses.map_err(|error| FileError::new(path, format_args!("poses: {error}")))?;
        check::check(&experiment).map_err(|problem| FileError::new(path, problem))?;
        Ok(experiment)
    }

    /// The part of the data set that is evaluated.
    #[must_use]
    pub fn part(&self) -> Part {
        Part {
            scenarios: self.scenarios,
            frames: self.frames,
            ..Default::default()
        }
    }
}
