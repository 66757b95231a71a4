//! `SCENARIO.yaml`: the description of one deployment.
//!
//! Its parts are the configuration types of the processes, with a default per field, so that a scenario needs only its
//! scene and its weights. `deploy/scenarios/demo.yaml` shows every field with its default, and
//! `deploy/scenarios/scenario.schema.json` describes them for editors.

mod check;
mod field_override;
pub mod fingerprint;
mod load;
mod overrides;
pub(crate) mod weights_choice;

use std::collections::BTreeMap;

use agent::config::{AgentSettings, ModelConfig};
use dataset::evaluation_protocol::ProtocolConfig;
use deploy::operate::network::Network;
use deploy::operate::security::Security;
use deploy::operate::timeouts::Timeouts;
use ego_fuser::config::EgoSettings;
use ego_fuser_offline::evaluation::stepped::ComputeTimes;
use fusion::Method;
use localization::pose_source::PoseSourceConfig;
use protocol::{CavId, RunId};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use sim_replay::config::{LinkSelection, RecordingConfig, SceneConfig};

pub use field_override::FieldOverride;
pub use overrides::AgentOverrides;

use support::provenance::Provenance;
use support::sampling::distinct;

/// A deployment: its scene, vehicles, method and network.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Scenario {
    /// Name of the run: second chunk of every key and name of the run folder. A time stamp when absent.
    #[serde(default)]
    pub run: Option<RunId>,
    /// The recording that drives the fleet; `dir` is relative to the scenario file.
    pub scene: SceneConfig,
    /// Clock of the run.
    #[serde(default)]
    pub clock: Clock,
    /// Settings of a run in simulation time; only with `clock: stepped`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub stepped: Option<Stepped>,
    /// Participating vehicles, counted annotations and objects. Agents and ego are chosen by `scene.agents` and
    /// `ego.id`.
    #[serde(default, skip_serializing_if = "is_default_protocol")]
    pub protocol: ProtocolConfig,
    /// Detector: weights, or a folder with a file `*-METHOD.safetensors` for each method, relative to the scenario
    /// file.
    pub models: ModelConfig,
    /// Fusion method of the ego.
    #[serde(default = "Scenario::default_method")]
    pub method: Method,
    /// Settings of every vehicle, unless `vehicles` has others.
    #[serde(default)]
    pub agents: AgentSettings,
    /// Settings of single vehicles, by id; a field given here takes precedence over `agents`.
    #[serde(default)]
    #[schemars(with = "BTreeMap<CavId, AgentSettings>")]
    pub vehicles: BTreeMap<CavId, AgentOverrides>,
    /// Vehicles whose agents are started on other hosts; the run waits for them.
    #[serde(default)]
    pub remote_agents: Vec<CavId>,
    /// The fusing vehicle.
    #[serde(default)]
    pub ego: EgoSettings,
    /// Link emulation between the neighbours and the ego. Absent: they are connected directly.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub link: Option<LinkSelection>,
    /// Recording of all messages in `recording.mcap`. Absent: none.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub record: Option<RecordingConfig>,
    /// Network of the processes.
    #[serde(default)]
    pub network: Network,
    /// Certificates of the processes; absent: none.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub security: Option<Security>,
    /// Timeouts.
    #[serde(default)]
    pub timeouts: Timeouts,
    /// Provenance of a run: written into the run folder, not read.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub provenance: Option<Provenance>,
}

fn is_default_protocol(protocol: &ProtocolConfig) -> bool {
    *protocol == ProtocolConfig::default()
}

/// Clock of a run.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum Clock {
    /// Wall clock.
    #[default]
    Wall,
    /// Simulation time: every stage takes the compute time of [`Stepped`], the link emulation computes the arrival
    /// times, and the ego decides on these as on a wall clock. Same scenario, same bytes.
    Stepped,
}

/// Settings of a run in simulation time.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct Stepped {
    /// Compute times of the stages; absent: measured once, and written into the `scenario.yaml` of the run.
    pub compute: Option<ComputeTimes>,
    /// True if every agent is a process of its own, which receives its sweeps and sends its feature maps over the
    /// network, all in lockstep. Slower, and the same bytes.
    pub processes: bool,
}

impl Scenario {
    fn default_method() -> Method {
        Method::MAX
    }

    /// Settings of all vehicles, then those of single ones.
    pub(crate) fn settings(&self) -> impl Iterator<Item = AgentSettings> {
        let own = self.vehicles.values().map(|own| own.over(&self.agents));
        std::iter::once(self.agents.clone()).chain(own)
    }

    /// Pose sources of the vehicles, each once.
    pub fn poses(&self) -> Vec<PoseSourceConfig> {
        distinct(self.settings().map(|settings| settings.pose))
    }

    /// True if a vehicle sends boxes where the method fuses feature maps.
    pub(crate) fn sends_boxes(&self) -> bool {
        self.settings().any(|settings| settings.boxes.is_some())
    }

    /// Settings of vehicle `cav`: `agents`, with its own entry of `vehicles` on top.
    pub(crate) fn settings_of(&self, cav: &CavId) -> AgentSettings {
        self.vehicles
            .get(cav)
            .map_or_else(|| self.agents.clone(), |own| own.over(&self.agents))
    }
}
