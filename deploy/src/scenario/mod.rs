//! `SCENARIO.yaml`: one deployment, written down.
//!
//! Every part is a typed struct with a default per field, so that a scenario needs to name nothing but its scene and
//! its weights. `deploy/scenarios/demo.yaml` shows every field with its default.

mod check;
mod error;
mod load;
mod vehicle;

use std::collections::BTreeMap;
use std::net::SocketAddr;
use std::path::PathBuf;

use bus::InboxLimits;
use ego_fuser_offline::evaluation::stepped::ComputeTimes;
use fusion::Method;
use protocol::{CavId, RunId, Stream};
use serde::{Deserialize, Serialize};

pub use error::ScenarioError;
pub use vehicle::{AgentOverrides, AgentSettings, Launch, NoiseMode, PoseNoise, PoseSource, Publish};

use dataset::evaluation_protocol::ProtocolConfig;

use crate::experiment::fingerprint::Provenance;

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
    /// What a run in virtual time is told; only with `clock: stepped`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub stepped: Option<Stepped>,
    /// Whose messages and annotations count, and which objects. Agents and ego are chosen by `scene.agents` and `ego.id`.
    #[serde(default, skip_serializing_if = "is_default_protocol")]
    pub protocol: ProtocolConfig,
    /// The networks.
    pub models: Models,
    /// How the ego fuses.
    #[serde(default = "Scenario::default_method")]
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
    /// The emulated air between the neighbours and the ego; absent: they hear each other directly.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub link: Option<Link>,
    /// Whether everything that is said is written to `recording.mcap`, and how; absent: it is not.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub record: Option<Record>,
    /// Where the processes meet.
    #[serde(default)]
    pub network: Network,
    /// Whether the processes show certificates to each other; absent: they do not.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub security: Option<Security>,
    /// How long to wait for what.
    #[serde(default)]
    pub timeouts: Timeouts,
    /// What a run was made of: written into the run folder, not read.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub provenance: Option<Provenance>,
}

fn is_default_protocol(protocol: &ProtocolConfig) -> bool {
    *protocol == ProtocolConfig::default()
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
    /// Which point files to read, where the data set has several (weather), for example `fog_0.060`.
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

/// The emulated air.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Link {
    /// A preset of `sim-replay link`, or a YAML file with the stages of a link, relative to the scenario file.
    pub air: PathBuf,
    /// Same seed, same losses and delays.
    #[serde(default)]
    pub seed: u64,
}

/// What is recorded of a run.
#[derive(Debug, Clone, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Record {
    /// Streams to leave out: feature maps (`bev`) are most of the bytes.
    pub without: Vec<Stream>,
    /// zstd level, 1 to 22; not packed when absent.
    pub zstd_level: Option<i32>,
}

/// Which clock a run keeps.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Clock {
    /// Messages take the time they take.
    #[default]
    Wall,
    /// Virtual time: everyone computes as long as [`Stepped`] says, the emulated air decides what arrives when, and the
    /// ego fuses exactly what has arrived `ego.deadline_ms` after a tick. Same scenario, same bytes.
    Stepped,
}

/// What a run in virtual time is told.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Stepped {
    /// How long everyone computes; absent: measured once, and written into the `scenario.yaml` of the run.
    pub compute: Option<ComputeTimes>,
    /// Whether every agent is a process of its own, which gets its sweeps and sends what it sees over the network, all in
    /// lockstep. Slower, and the same bytes.
    pub processes: bool,
}

/// The networks.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Models {
    /// Weights of the detector (safetensors; its configuration is inside), or a folder with a file `*-METHOD.safetensors`
    /// for each method. Relative to the scenario file.
    pub weights: PathBuf,
    /// The networks that find poses; needed by vehicles whose pose is `pgc`.
    #[serde(default)]
    pub localizer: Option<LocalizerModels>,
    /// A network that was trained end to end on the scene's town; needed by vehicles whose pose is `end_to_end`. Relative
    /// to the scenario file.
    #[serde(default)]
    pub end_to_end: Option<PathBuf>,
    /// Threads each process computes with.
    #[serde(default = "Models::default_threads")]
    pub threads: usize,
}

/// Weights that find a vehicle's pose in its sweep.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct LocalizerModels {
    /// The encoder, the same for all towns. Relative to the scenario file.
    pub encoder: PathBuf,
    /// The head of the scene's town. Relative to the scenario file.
    pub head: PathBuf,
}

impl Models {
    fn default_threads() -> usize {
        1
    }
}

impl Scenario {
    fn default_method() -> Method {
        Method::MAX
    }

    /// Whether some vehicle finds its pose itself with the networks of `models.localizer`.
    #[must_use]
    pub fn uses_localizer(&self) -> bool {
        self.some_pose_is(PoseSource::Pgc)
    }

    /// Whether some vehicle finds its pose itself with the network of `models.end_to_end`.
    #[must_use]
    pub fn uses_end_to_end(&self) -> bool {
        self.some_pose_is(PoseSource::EndToEnd)
    }

    fn some_pose_is(&self, source: PoseSource) -> bool {
        let own = self.vehicles.values().filter_map(|vehicle| vehicle.pose.as_ref());
        own.chain([&self.agents.pose]).any(|pose| *pose == source)
    }

    /// What vehicle `cav` does: `agents`, with its own entry of `vehicles` on top.
    #[must_use]
    pub fn settings_of(&self, cav: &CavId) -> AgentSettings {
        let base = &self.agents;
        let Some(own) = self.vehicles.get(cav) else { return base.clone() };
        AgentSettings {
            pose: own.pose.unwrap_or(base.pose),
            codec: own.codec.unwrap_or(base.codec),
            rate: own.rate.unwrap_or(base.rate),
            launch: own.launch.unwrap_or(base.launch),
            lie: own.lie.or(base.lie),
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
    /// Whether neighbours whose words do not fit what the ego sees itself are left out.
    pub trust: bool,
    /// Messages that each vehicle may bring it a second; what is more is dropped unread (`rate_limit`).
    pub peer_messages_per_s: f64,
    /// The same in MiB a second.
    pub peer_mib_per_s: f64,
}

impl Default for Ego {
    fn default() -> Self {
        let InboxLimits { messages_per_s, bytes_per_s, .. } = InboxLimits::PEERS;
        Self {
            id: None,
            deadline_ms: 100,
            max_age_ms: 150,
            trust: false,
            peer_messages_per_s: messages_per_s,
            peer_mib_per_s: bytes_per_s / f64::from(1 << 20),
        }
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
    /// Shared memory for large messages between processes of one machine, MiB; 0: everything takes the socket.
    pub shared_memory_mib: usize,
    /// How long the router inside this run may take to hand one message to one receiver, seconds, before it closes that
    /// connection. Meanwhile it delivers nothing else of the same sender: a receiver behind a slow link needs more (8 MiB at
    /// 13 Mbit/s take 5 s), and everybody else waits for it.
    pub stall_limit_s: f64,
    /// Where the scorer serves its counters to Prometheus; the other processes take the ports behind it, in the order in
    /// which they are started. Not served when absent.
    pub metrics: Option<SocketAddr>,
}

impl Default for Network {
    fn default() -> Self {
        Self {
            listen: "tcp/127.0.0.1:0".into(),
            connect: None,
            shared_memory_mib: 0,
            stall_limit_s: 5.0,
            metrics: None,
        }
    }
}

/// QUIC between all processes, and for each of them only what is its to say.
#[derive(Debug, Clone, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Security {
    /// Folder that `v2vloc keys` has written, relative to the scenario file; absent: keys are made for this run alone.
    pub keys: Option<PathBuf>,
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
    /// For a process that has fallen silent to say something, before it is killed and started again, seconds. One whose work
    /// stands still falls silent too: longer than the slowest frame takes.
    pub hang_s: f64,
}

impl Default for Timeouts {
    fn default() -> Self {
        Self { ready_s: 60.0, drain_s: 3.0, stop_s: 4.0, restarts: 5, hang_s: 15.0 }
    }
}
