//! Recorded scene of a run, and options of its replay.

use std::path::PathBuf;

use protocol::CavId;
use protocol::config::{FieldError, require, within};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use dataset::IntensityScale;

/// Recorded scene of a run, and options of its replay.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema, clap::Args)]
#[serde(deny_unknown_fields)]
#[command(next_help_heading = "Scene")]
pub struct SceneConfig {
    /// Data set, split or scenario; the layout is detected.
    #[arg(required_unless_present = "config")]
    pub dir: PathBuf,
    /// Scenario of the data set. Absent: the first.
    #[arg(long, value_name = "NAME")]
    #[serde(default)]
    pub scenario: Option<String>,
    /// Vehicles that take part. None named: those of the evaluation protocol, in `sim-replay stream` all.
    #[arg(long, value_name = "IDS", value_delimiter = ',')]
    #[arg(allow_hyphen_values = true)]
    #[serde(default)]
    pub agents: Vec<CavId>,
    /// Variant of the sweeps, if the data set has several (weather), for example fog_0.060. Absent: the plain ones.
    #[arg(long)]
    #[serde(default)]
    pub variant: Option<String>,
    /// Divisor of stored intensities: auto, 1, 255 or another number (`sim-replay inspect --help` explains auto).
    #[arg(long, value_name = "auto|1|255|NUMBER")]
    #[serde(default)]
    pub intensity_scale: IntensityScale,
    /// Publish radar sweeps too.
    #[arg(long)]
    #[serde(default)]
    pub radar: bool,
    /// Publish camera images too.
    #[arg(long)]
    #[serde(default)]
    pub cameras: bool,
    /// Seconds of the scene per second; 0, in `sim-replay stream` alone: as fast as the subscribers accept it, without drops.
    #[arg(long, value_name = "TIMES")]
    #[serde(default = "SceneConfig::recorded_rate")]
    pub rate: f64,
    /// First tick, counted from 0.
    #[arg(long, value_name = "TICK")]
    #[serde(default)]
    pub seek: usize,
    /// Ticks to play; with `loop` it may exceed those of the scene. Absent: to the end, or without end with `loop`.
    #[arg(long, value_name = "TICKS")]
    #[serde(default)]
    pub frames: Option<usize>,
    /// Start again after the last tick.
    #[arg(id = "loop", long = "loop")]
    #[serde(default, rename = "loop")]
    pub repeat: bool,
    /// Publish a tick only when the egos have answered the previous one: slow, but no message is late.
    #[arg(long)]
    #[serde(default)]
    pub lockstep: bool,
}

impl SceneConfig {
    fn recorded_rate() -> f64 {
        1.0
    }

    /// Checks the values.
    ///
    /// # Errors
    /// [`FieldError`] for the first invalid value.
    pub fn validate(&self) -> Result<(), FieldError> {
        for (place, cav) in self.agents.iter().enumerate() {
            let is_first = !self.agents[..place].contains(cav);
            let rule = "must name each vehicle once";
            require(is_first, "scene.agents", cav.as_str(), rule)?;
        }
        within("scene.rate", self.rate, 0.0, 1e3)?;
        within("scene.frames", self.frames.unwrap_or(1), 1, usize::MAX)
    }
}
