//! Configuration of `ego-fuser run`: one type for file, options and JSON schema.

use std::path::PathBuf;

use agent::config::ModelConfig;
use bus::{BusConfig, InboxConfig, ProcessConfig};
use protocol::config::{FieldError, within};
use protocol::{CavId, RunId};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use crate::ego::Ego;
use fusion::method::Method;

/// Configuration of `ego-fuser run`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema, clap::Args)]
#[serde(deny_unknown_fields)]
pub struct EgoConfig {
    /// Name of the run: 1 to 32 characters of a-z, 0-9, '_' and '-'.
    #[arg(long, required_unless_present = "config")]
    pub run: RunId,
    /// Detector, threads and device.
    #[command(flatten)]
    pub models: ModelConfig,
    /// A method of `ego-fuser methods`. Absent: the one that the weights were trained for.
    #[arg(long)]
    #[serde(default)]
    pub method: Option<Method>,
    /// Neighbours that may take part. None named: all that are discovered.
    #[arg(
        long,
        value_name = "IDS",
        value_delimiter = ',',
        allow_hyphen_values = true
    )]
    #[serde(default)]
    pub neighbours: Vec<CavId>,
    /// Communication range: neighbours farther away are ignored, metres in the plane.
    #[arg(long, value_name = "M")]
    #[serde(default = "comm_range_m")]
    pub comm_range_m: f64,
    /// Receive neighbours through link emulation (`sim-replay link`) and not directly.
    #[arg(long)]
    #[serde(default)]
    pub over_link: bool,
    /// Continue when the own agent ends, for its next instance; always set with `supervised`.
    #[arg(long)]
    #[serde(default)]
    pub keep_running: bool,
    /// Record everything that enters the ego's decisions into this file, for `ego-fuser replay-inputs`.
    #[arg(long, value_name = "FILE")]
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub inputs: Option<PathBuf>,
    /// Vehicle, deadline, age, misbehaviour detection and limits.
    #[command(flatten)]
    #[serde(default)]
    pub ego: EgoSettings,
    /// Connection to the router.
    #[command(flatten)]
    #[serde(default)]
    pub bus: BusConfig,
}

fn comm_range_m() -> f64 {
    Ego::COMM_RANGE_M
}

/// Settings of the fusing vehicle: the same in a scenario and an experiment.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema, clap::Args)]
#[serde(default, deny_unknown_fields)]
pub struct EgoSettings {
    /// The vehicle that fuses. Absent in a scenario: the first of its scene.
    #[arg(
        id = "ego",
        long = "ego",
        value_name = "ID",
        required_unless_present = "config",
        allow_hyphen_values = true
    )]
    pub id: Option<CavId>,
    /// Longest time that a frame waits for its neighbours, from the arrival of the own agent's message, milliseconds.
    #[arg(long, value_name = "MS")]
    #[schemars(range(max = 60_000))]
    pub deadline_ms: u64,
    /// Largest age of a neighbour's message that is still fused, by capture time, milliseconds.
    #[arg(long, value_name = "MS")]
    #[schemars(range(max = 600_000))]
    pub max_age_ms: u64,
    /// Sweeps that the vehicles compute: as many as this ego has time for, or every one.
    #[arg(long, value_enum)]
    pub pace: PaceMode,
    /// Leave out neighbours whose messages contradict what the ego perceives itself.
    #[arg(long)]
    pub trust: bool,
    /// Align the boxes of neighbours (`late`; boxes as an input of other methods always are): carried to the time of the
    /// ego's frame by the velocities of their tracks, at a pose that the ego corrects by the boxes that it detects, too.
    #[arg(long)]
    pub box_alignment: bool,
    /// Track the detected objects, and publish their identities and velocities (stream `tracks`).
    #[arg(long)]
    pub tracks: bool,
    /// Limits of the messages of other vehicles.
    #[command(flatten)]
    pub inbox: InboxConfig,
}

/// Sweeps that the vehicles of a fleet compute.
#[derive(
    Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize, JsonSchema, clap::ValueEnum,
)]
#[serde(rename_all = "snake_case")]
#[value(rename_all = "snake_case")]
pub enum PaceMode {
    /// As many as the ego has time for, the same in all vehicles: where a machine cannot keep up, answers come less often
    /// instead of later.
    #[default]
    Auto,
    /// Every sweep that an agent has time for.
    EverySweep,
}

impl Default for EgoSettings {
    fn default() -> Self {
        Self {
            id: None,
            deadline_ms: 100,
            max_age_ms: 150,
            pace: PaceMode::Auto,
            trust: false,
            box_alignment: false,
            tracks: true,
            inbox: InboxConfig::default(),
        }
    }
}

impl EgoSettings {
    /// Checks the values.
    ///
    /// # Errors
    /// [`FieldError`] for the first that is not allowed.
    pub fn validate(&self) -> Result<(), FieldError> {
        within("ego.deadline_ms", self.deadline_ms, 0, 60_000)?;
        within("ego.max_age_ms", self.max_age_ms, 0, 600_000)?;
        self.inbox.validate()
    }
}

impl ProcessConfig for EgoConfig {
    const REQUIRED: &'static [&'static str] = &["run", "models.weights"];

    fn validate(&self) -> Result<(), FieldError> {
        self.models.validate()?;
        self.ego.validate()?;
        if self.ego.id.is_none() {
            let rule = "must name the vehicle that fuses (--ego)";
            return Err(FieldError::new("ego.id", "absent", rule));
        }
        within("comm_range_m", self.comm_range_m, 0.0, 1e5)?;
        self.bus.validate()
    }
}
