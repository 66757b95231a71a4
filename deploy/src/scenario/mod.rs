//! `SCENARIO.yaml`: one deployment, written down.
//!
//! Every part is a typed struct with a default per field, so that a scenario needs to name nothing but its scene and
//! its weights. `deploy/scenarios/demo.yaml` shows every field with its default.

mod load;

use std::collections::BTreeMap;
use std::path::PathBuf;

use protocol::{CavId, RunId};
use serde::{Deserialize, Serialize};

pub use load::ScenarioError;

/// A deployment: which scene, which vehicles, which method, which network.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Scenario {
    /// Name of the run: second chunk of every key and name of the run folder. A time stamp when absent.
    #[serde(default)]
    pub run: Option<RunId>,
    /// The recording that drives the fleet.
    pub scene: Scene,
    /// Which clock the run keeps.
    #[serde(default)]
    pub clock: Clock,
    /// The networks.
    pub models: Models,
    /// How the ego fuses.
    #[serde(default)]
    pub method: Method,
    /// What every vehicle does unless `vehicles` says otherwise.
    #[serde(default)]
    pub agents: AgentSettings,
    /// Settings of single vehicles, by id; a field given here wins over `agents`.
    #[serde(default)]
    pub vehicles: BTreeMap<CavId, AgentOverrides>,
    /// The fusing vehicle.
    #[serde(default)]
    pub ego: Ego,
    /// Where the processes meet.
    #[serde(default)]
    pub network: Network,
    /// How long to wait for what.
    #[serde(default)]
    pub timeouts: Timeouts,
}

/// The recording that drives the fleet, and how it is played.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Scene {
    /// Root of the data set, or a split or scenario folder in it. Relative to the scenario file.
    pub dir: PathBuf,
    /// Which scenario of the data set; the first when absent.
    #[serde(default)]
    pub scenario: Option<String>,
    /// Which vehicles take part; all when empty.
    #[serde(default)]
    pub agents: Vec<CavId>,
    /// Which point files to read, where the data set has several (weather), for example `_fog_0.060`.
    #[serde(default)]
    pub variant: Option<String>,
    /// Speed in times the recorded speed.
    #[serde(default = "Scene::default_rate")]
    pub rate: f64,
    /// First tick to play.
    #[serde(default)]
    pub seek: usize,
    /// Ticks to play; with `loop` it may exceed those of the scene. Without it a looped scene plays until Ctrl-C.
    #[serde(default)]
    pub frames: Option<usize>,
    /// Start again after the last tick.
    #[serde(default, rename = "loop")]
    pub repeat: bool,
    /// Play the next tick only after the ego has reported on this one: slow, but nothing is ever late.
    #[serde(default)]
    pub lockstep: bool,
}

impl Scene {
    fn default_rate() -> f64 {
        1.0
    }
}

/// Which clock a run keeps.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Clock {
    /// Messages take the time they take.
    #[default]
    Wall,
}

/// The networks.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Models {
    /// Weights of the detector (safetensors; its configuration is inside). Relative to the scenario file.
    pub weights: PathBuf,
    /// Threads each process computes with.
    #[serde(default = "Models::default_threads")]
    pub threads: usize,
}

impl Models {
    fn default_threads() -> usize {
        1
    }
}

/// How the ego fuses what the vehicles send.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Method {
    /// The ego alone.
    None,
    /// Boxes of everyone, suppressed together.
    Late,
    /// Points of everyone, through one detector.
    Early,
    /// Feature maps, cell-wise maximum (F-Cooper).
    Max,
    /// Feature maps, per-cell attention over vehicles (AttFuse).
    #[default]
    Attention,
}

impl Method {
    /// All methods, in the order tables show them.
    pub const ALL: [Self; 5] = [Self::None, Self::Late, Self::Early, Self::Max, Self::Attention];

    /// The name used in files and on command lines.
    #[must_use]
    pub fn name(self) -> &'static str {
        match self {
            Self::None => "none",
            Self::Late => "late",
            Self::Early => "early",
            Self::Max => "max",
            Self::Attention => "attention",
        }
    }

    /// The stream that vehicles have to publish for this method.
    #[must_use]
    pub fn stream(self) -> Publish {
        match self {
            Self::None | Self::Max | Self::Attention => Publish::Bev,
            Self::Late => Publish::Boxes,
            Self::Early => Publish::Points,
        }
    }
}

impl std::fmt::Display for Method {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.pad(self.name())
    }
}

impl std::str::FromStr for Method {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let names = || Self::ALL.map(Self::name).join(", ");
        Self::ALL
            .into_iter()
            .find(|method| method.name() == text)
            .ok_or_else(|| format!("{text:?} is no fusion method: one of {}", names()))
    }
}

/// What a vehicle puts on the air beside its pose.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Publish {
    /// Feature maps.
    Bev,
    /// Its own detections.
    Boxes,
    /// Its points (only for the early-fusion baseline).
    Points,
}

impl Publish {
    /// The name used in keys and on command lines.
    #[must_use]
    pub fn name(self) -> &'static str {
        match self {
            Self::Bev => "bev",
            Self::Boxes => "boxes",
            Self::Points => "points",
        }
    }
}

/// How a feature map's numbers are written.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Dtype {
    /// 4 bytes, exact.
    F32,
    /// 2 bytes.
    #[default]
    F16,
    /// 1 byte and a scale per channel.
    I8,
}

impl Dtype {
    /// The name used in files and on command lines.
    #[must_use]
    pub fn name(self) -> &'static str {
        match self {
            Self::F32 => "f32",
            Self::F16 => "f16",
            Self::I8 => "i8",
        }
    }
}

/// Where a vehicle takes its pose from.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case", deny_unknown_fields)]
pub enum PoseSource {
    /// The pose of the recording.
    #[default]
    Recorded,
    /// The pose of the recording plus noise.
    Noisy(PoseNoise),
}

impl PoseSource {
    /// The name used in files and on command lines.
    #[must_use]
    pub fn name(&self) -> &'static str {
        match self {
            Self::Recorded => "recorded",
            Self::Noisy(_) => "noisy",
        }
    }
}

/// Noise on a recorded pose.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct PoseNoise {
    /// How the errors of successive frames hang together.
    pub mode: NoiseMode,
    /// Standard deviation of x and y, metres.
    pub std_m: f64,
    /// Standard deviation of the heading, degrees.
    pub std_deg: f64,
    /// Seed of the errors.
    pub seed: u64,
}

impl Default for PoseNoise {
    fn default() -> Self {
        Self { mode: NoiseMode::default(), std_m: 0.2, std_deg: 0.2, seed: 0 }
    }
}

/// How the errors of successive frames hang together.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum NoiseMode {
    /// One offset for the whole run, as the reference code does.
    Fixed,
    /// A new error every frame.
    #[default]
    Independent,
    /// Errors that drift: first-order autoregressive.
    Autoregressive,
}

/// What a vehicle computes and sends.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct AgentSettings {
    /// Where the pose comes from.
    pub pose: PoseSource,
    /// Number format of feature maps on the air.
    pub dtype: Dtype,
    /// Bytes a feature map may take, cells chosen by confidence; every cell when absent.
    pub budget_bytes: Option<u64>,
    /// Whether bodies are compressed (zstd).
    pub zstd: bool,
    /// What goes on the air; what the method needs when absent.
    pub publish: Option<Publish>,
    /// Who starts the process.
    pub launch: Launch,
}

/// Who starts a vehicle's process.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Launch {
    /// This run does, here.
    #[default]
    Here,
    /// Someone else does, on another host; the run waits for it.
    Elsewhere,
}

/// Settings of one vehicle that differ from `agents`.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct AgentOverrides {
    /// See [`AgentSettings::pose`].
    pub pose: Option<PoseSource>,
    /// See [`AgentSettings::dtype`].
    pub dtype: Option<Dtype>,
    /// See [`AgentSettings::budget_bytes`].
    pub budget_bytes: Option<u64>,
    /// See [`AgentSettings::zstd`].
    pub zstd: Option<bool>,
    /// See [`AgentSettings::publish`].
    pub publish: Option<Publish>,
    /// See [`AgentSettings::launch`].
    pub launch: Option<Launch>,
}

impl Scenario {
    /// What vehicle `cav` does: `agents`, with its own entry of `vehicles` on top.
    #[must_use]
    pub fn settings_of(&self, cav: &CavId) -> AgentSettings {
        let base = &self.agents;
        let Some(own) = self.vehicles.get(cav) else { return base.clone() };
        AgentSettings {
            pose: own.pose.unwrap_or(base.pose),
            dtype: own.dtype.unwrap_or(base.dtype),
            budget_bytes: own.budget_bytes.or(base.budget_bytes),
            zstd: own.zstd.unwrap_or(base.zstd),
            publish: own.publish.or(base.publish),
            launch: own.launch.unwrap_or(base.launch),
        }
    }
}

/// The fusing vehicle.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Ego {
    /// Which vehicle fuses; the first of the scene when absent.
    pub id: Option<CavId>,
    /// How long the ego waits for its neighbours after its own map of a tick, milliseconds.
    pub deadline_ms: u64,
    /// Oldest neighbour map that is still fused, by capture time, milliseconds.
    pub max_age_ms: u64,
}

impl Default for Ego {
    fn default() -> Self {
        Self { id: None, deadline_ms: 100, max_age_ms: 150 }
    }
}

/// Where the processes meet.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Network {
    /// Where the router inside this run listens; port 0 takes any free one.
    pub listen: String,
    /// A router that runs already (`zenohd`), for example `tcp/10.0.0.1:7447`; no router is started then.
    pub connect: Option<String>,
}

impl Default for Network {
    fn default() -> Self {
        Self { listen: "tcp/127.0.0.1:0".into(), connect: None }
    }
}

/// How long to wait for what.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Timeouts {
    /// For every process to be ready before the first tick, seconds.
    pub ready_s: f64,
    /// For the last detections after the last tick, seconds.
    pub drain_s: f64,
    /// For the processes to end before they are killed, seconds.
    pub stop_s: f64,
    /// How often a process that keeps failing is started again.
    pub restarts: u32,
}

impl Default for Timeouts {
    fn default() -> Self {
        Self { ready_s: 60.0, drain_s: 5.0, stop_s: 4.0, restarts: 5 }
    }
}
