//! Configuration of `agent run`: one type for file, options and JSON schema.

use std::num::ParseIntError;
use std::path::PathBuf;
use std::str::FromStr;

use bus::{BusConfig, ProcessConfig};
use protocol::config::{FieldError, within};
use protocol::{CavId, CodecConfig, RunId, Stream};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use crate::attack::Falsification;
use crate::node::NodeOptions;
use crate::rate::RateConfig;
use localization::pose_source::PoseSourceConfig;
use perception::compute_device::{ComputeDevice, NoCuda};
use perception::inference::Inference;
use perception::int8::InferencePrecision;
use perception::weights::{Weights, WeightsError};

/// Configuration of `agent run`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema, clap::Args)]
#[serde(deny_unknown_fields)]
pub struct AgentConfig {
    /// Name of the run: 1 to 32 characters of a-z, 0-9, '_' and '-'.
    #[arg(long, required_unless_present = "config")]
    pub run: RunId,
    /// The vehicle.
    #[arg(long, required_unless_present = "config", allow_hyphen_values = true)]
    pub cav: CavId,
    /// Messages to publish beside the pose.
    #[arg(long, value_enum, value_delimiter = ',')]
    #[serde(default = "Publish::maps")]
    pub publish: Vec<Publish>,
    /// Keep running when the replay ends, for the next one; always so with `supervised`.
    #[arg(long)]
    #[serde(default)]
    pub keep_running: bool,
    /// Log of the arrival of each sweep: capture time and arrival, nanoseconds.
    #[arg(long, value_name = "FILE")]
    #[serde(default)]
    pub sweep_log: Option<PathBuf>,
    /// Detector, threads and device.
    #[command(flatten)]
    pub models: ModelConfig,
    /// Pose, codec and rate control.
    #[command(flatten)]
    #[serde(default)]
    pub settings: AgentSettings,
    /// Connection to the router.
    #[command(flatten)]
    #[serde(default)]
    pub bus: BusConfig,
}

/// Detector of a process, and where and with how many threads it computes.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, JsonSchema, clap::Args)]
#[serde(deny_unknown_fields)]
pub struct ModelConfig {
    /// Weights of the detector (safetensors; its configuration is inside).
    #[arg(long, value_name = "FILE", required_unless_present = "config")]
    pub weights: PathBuf,
    /// Number format in which networks are computed.
    #[arg(long, value_enum, default_value_t)]
    #[serde(default)]
    pub precision: InferencePrecision,
    /// Threads that libtorch computes with, 1 to 256; the same number gives the same bits.
    #[arg(long)]
    #[serde(default)]
    pub threads: Threads,
    /// Device that the networks compute on; cuda needs a libtorch with CUDA and a CUDA device, and its results are
    /// slightly different.
    #[arg(long, value_enum)]
    #[serde(default)]
    pub device: ComputeDevice,
}

impl ModelConfig {
    /// Checks that the processes can compute as configured.
    ///
    /// # Errors
    /// [`FieldError`] for a number of threads out of range, or a device that is missing.
    pub fn validate(&self) -> Result<(), FieldError> {
        self.threads.validate()?;
        self.inference().map(drop)
    }

    /// Reads the weights, to compute with as [`Self::inference`] says.
    ///
    /// # Errors
    /// [`WeightsError`] names the file.
    pub fn load(&self, inference: Inference) -> Result<Weights, WeightsError> {
        Ok(Weights::load(&self.weights)?.with_precision(inference.precision))
    }

    /// Device and number format of the networks.
    ///
    /// # Errors
    /// [`FieldError`] names what a device needs and this machine lacks.
    pub fn inference(&self) -> Result<Inference, FieldError> {
        let missing =
            |missing: NoCuda| FieldError::new("models.device", "cuda", missing.to_string());
        Ok(Inference::new(
            self.device.open().map_err(missing)?,
            self.precision,
        ))
    }
}

/// Settings of a vehicle's agent: the same in a scenario, for all vehicles or for one.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize, JsonSchema, clap::Args)]
#[serde(default, deny_unknown_fields)]
pub struct AgentSettings {
    /// Pose source.
    #[command(flatten, next_help_heading = "Pose")]
    pub pose: PoseSourceConfig,
    /// Codec of feature maps: number format, cells, byte budget, compression.
    #[command(flatten)]
    pub codec: CodecConfig,
    /// Rate control of feature maps: a size, a byte rate, the vehicle's own queue.
    #[command(flatten)]
    pub rate: RateConfig,
    /// Falsification of the vehicle's messages, to measure its effect on the ego. Absent: none.
    #[arg(long, value_enum, help_heading = "Attack")]
    #[serde(skip_serializing_if = "Option::is_none")]
    pub falsification: Option<Falsification>,
}

/// A message beside the pose.
#[derive(
    Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema, clap::ValueEnum,
)]
#[serde(rename_all = "snake_case")]
pub enum Publish {
    /// BEV feature maps.
    Bev,
    /// Detections of this vehicle by itself.
    Boxes,
    /// Points, for the early-fusion baseline.
    Points,
}

impl Publish {
    fn maps() -> Vec<Self> {
        vec![Self::Bev]
    }

    /// Stream of these messages.
    #[must_use]
    pub fn stream(self) -> Stream {
        match self {
            Self::Bev => Stream::Bev,
            Self::Boxes => Stream::Boxes,
            Self::Points => Stream::Points,
        }
    }
}

/// Number of threads that libtorch computes with, 1 to 256.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[schemars(extend("minimum" = 1, "maximum" = 256))]
pub struct Threads(pub u16);

impl Default for Threads {
    fn default() -> Self {
        Self(1)
    }
}

impl FromStr for Threads {
    type Err = ParseIntError;

    fn from_str(text: &str) -> Result<Self, ParseIntError> {
        text.parse().map(Self)
    }
}

impl Threads {
    /// Sets the number of threads of libtorch.
    pub fn apply(self) {
        tch::set_num_threads(i32::from(self.0));
    }

    /// Checks the range.
    ///
    /// # Errors
    /// [`FieldError`] for a number outside of 1 to 256.
    pub fn validate(self) -> Result<(), FieldError> {
        within("models.threads", self.0, 1, 256)
    }
}

impl AgentSettings {
    /// Checks the values.
    ///
    /// # Errors
    /// [`FieldError`] of the first value that is out of range.
    pub fn validate(&self) -> Result<(), FieldError> {
        self.pose.validate()?;
        within(
            "codec.zstd_level",
            self.codec.zstd_level.unwrap_or(1),
            1,
            22,
        )
    }
}

impl ProcessConfig for AgentConfig {
    const REQUIRED: &'static [&'static str] = &["run", "cav", "models.weights"];

    fn validate(&self) -> Result<(), FieldError> {
        self.models.validate()?;
        self.settings.validate()?;
        self.bus.validate()
    }
}

impl AgentConfig {
    /// Options of the agent's node.
    #[must_use]
    pub fn options(&self) -> NodeOptions {
        NodeOptions {
            publish: self
                .publish
                .iter()
                .map(|publish| publish.stream())
                .collect(),
            codec: self.settings.codec,
            rate: self.settings.rate,
            keeps_running: self.keep_running || self.bus.supervised,
            sweep_log: self.sweep_log.clone(),
            ..NodeOptions::default()
        }
    }
}
