//! Which processes a scenario needs, and with which arguments.

mod arguments;
mod error;
mod routes;

use std::path::{Path, PathBuf};

use dataset;
use dataset::evaluation_protocol::{EvaluationProtocol, ProtocolConfig};
use dataset::ground_truth::GroundTruthRule;
use fusion::Exchange;
use link::Air;
use localization::competitors::EndToEndLocalizer;
use localization::pgc::Localizer;
use perception::model_config::DetectorConfig;
use perception::weights::Weights;
use protocol::{CavId, Party, Role, Stream};
use tch::Device;

pub use self::arguments::Meeting;
use self::arguments::{Arguments, dtype, noise_mode, rate_options, smoothing};
pub use self::error::FleetError;
use crate::experiment::weights_choice::weights_of;
use crate::operate::keys::KeyError;
use crate::operate::run_folder::{BOOKMARK, RECORDING, RunFolder, SWEEP_LOG};
use crate::operate::security::RunKeys;
use crate::operate::supervise::{Life, ProcessSpec};
use crate::scenario::{Clock, Launch, PoseSource, Publish, Scenario};

/// Name of the process that plays the scene.
pub const REPLAY: &str = "replay";
/// Name of the process that writes everything down.
pub const RECORDER: &str = "recorder";

/// A scenario with everything filled in that it leaves open.
#[derive(Debug, Clone)]
pub struct Fleet {
    /// The scenario, with scene and vehicles named.
    pub scenario: Scenario,
    /// Every vehicle that takes part, in the scene's order.
    pub agents: Vec<CavId>,
    /// The fusing one.
    pub ego: CavId,
    /// Ticks that will be played; `None`: until someone ends it.
    pub ticks: Option<usize>,
    /// Folder of the recorded scenario, for its hash.
    pub scene_dir: PathBuf,
    /// The model, as its weights say.
    pub detector: DetectorConfig,
    /// How the run is judged.
    pub protocol: EvaluationProtocol,
}

/// Refuses options of a protocol that a live run has other fields for.
fn chosen_elsewhere(protocol: &ProtocolConfig) -> Result<(), FleetError> {
    let options = [
        ("agents", protocol.agents.is_some()),
        ("ego", protocol.ego.is_some()),
        ("max_agents", protocol.max_agents.is_some()),
    ];
    match options.iter().find(|(_, is_given)| *is_given) {
        Some((option, _)) => Err(FleetError::Protocol(format!("{option}: choose by scene.agents and ego.id instead"))),
        None => Ok(()),
    }
}

impl Fleet {
    /// Looks into scene and weights.
    ///
    /// # Errors
    /// [`FleetError`] says what the scene or the weights lack.
    pub fn plan(scenario: &Scenario) -> Result<Self, FleetError> {
        let mut scenario = scenario.clone();
        scenario.models.weights = weights_of(&scenario.models.weights, scenario.method)?;
        let detector = Weights::load(&scenario.models.weights)?.config()?;
        if let Some(models) = scenario.models.localizer.as_ref().filter(|_| scenario.uses_localizer()) {
            // Every vehicle loads them for itself; what is wrong with them is better said once.
            Localizer::load(&models.encoder, &models.head, Device::Cpu)?;
        }
        if let Some(weights) = scenario.models.end_to_end.as_ref().filter(|_| scenario.uses_end_to_end()) {
            EndToEndLocalizer::load(weights, Device::Cpu)?;
        }
        if let Some(link) = &scenario.link {
            Air::open(&link.air.to_string_lossy(), link.seed)?;
        }
        let scene = &mut scenario.scene;
        let dataset = dataset::open(&scene.dir)?;
        chosen_elsewhere(&scenario.protocol)?;
        let protocol = scenario.protocol.resolve(dataset.layout).map_err(FleetError::Protocol)?;
        let recorded = match &scene.scenario {
            None => dataset.scenarios.first().ok_or_else(|| FleetError::Empty(scene.dir.clone()))?,
            Some(name) => {
                dataset.scenarios.iter().find(|known| known.name == *name).ok_or_else(|| FleetError::NoScenario {
                    dir: scene.dir.clone(),
                    asked: name.clone(),
                    found: dataset.scenarios.iter().map(|known| known.name.clone()).collect(),
                })?
            }
        };
        let name = recorded.name.clone();
        if recorded.ticks.is_empty() {
            let agents = recorded.agents.iter().map(ToString::to_string).collect();
            return Err(FleetError::NoFrames { dir: scene.dir.clone(), name, agents });
        }
        if scene.seek >= recorded.ticks.len() {
            return Err(FleetError::Seek { seek: scene.seek, name, ticks: recorded.ticks.len() });
        }
        let known = |field, cav: &CavId| {
            if recorded.agents.contains(cav) {
                return Ok(());
            }
            let found = recorded.agents.iter().map(ToString::to_string).collect();
            Err(FleetError::NoVehicle { field, cav: cav.clone(), name: name.clone(), found })
        };
        scene.agents.iter().try_for_each(|cav| known("scene.agents", cav))?;
        scenario.ego.id.iter().try_for_each(|cav| known("ego.id", cav))?;
        scenario.vehicles.keys().try_for_each(|cav| known("vehicles", cav))?;
        let chosen = |cav: &&CavId| scene.agents.is_empty() || scene.agents.contains(cav);
        let agents: Vec<CavId> = recorded.agents.iter().filter(chosen).cloned().collect();
        let ego = scenario.ego.id.clone().unwrap_or_else(|| agents[0].clone());
        for cav in &agents {
            let pose = scenario.settings_of(cav).pose;
            let needs_poses = matches!(pose, PoseSource::Recorded | PoseSource::Noisy(_));
            let place = recorded.agents.iter().position(|known| known == cav);
            if needs_poses && place.is_some_and(|place| !recorded.has_poses(place, scenario.scene.seek)) {
                return Err(FleetError::NoPoses { cav: cav.clone(), source_name: pose.name(), name });
            }
        }
        let scene = &mut scenario.scene;
        let left = recorded.ticks.len() - scene.seek;
        let ticks =
            if scene.repeat { scene.frames } else { Some(scene.frames.map_or(left, |frames| frames.min(left))) };
        let scene_dir = Some(scene.dir.join(&name)).filter(|folder| folder.is_dir()).unwrap_or(scene.dir.clone());
        scene.scenario = Some(name);
        scene.agents.clone_from(&agents);
        scenario.ego.id = Some(ego.clone());
        Ok(Self { scenario, agents, ego, ticks, scene_dir, detector, protocol })
    }

    /// Which objects count: those of the protocol that lie over the area of the model.
    #[must_use]
    pub fn ground_truth_rule(&self) -> GroundTruthRule {
        self.protocol.rule_within(self.detector.lidar_range_m)
    }

    /// Numbers in one feature map of the model, as it crosses the air.
    #[must_use]
    pub fn map_values(&self) -> u64 {
        let grid = self.detector.feature_grid();
        u64::from(grid.width) * u64::from(grid.height) * self.detector.sent_channels() as u64
    }

    /// Where poses come from: the name that all vehicles share, or `mixed`.
    #[must_use]
    pub fn pose_source(&self) -> &'static str {
        let mut names = self.agents.iter().map(|cav| self.scenario.settings_of(cav).pose.name());
        let first = names.next().unwrap_or("recorded");
        if names.all(|name| name == first) { first } else { "mixed" }
    }

    /// Every process that the run may have, for its keys.
    #[must_use]
    pub fn parties(&self) -> Vec<Party> {
        let agents = self.agents.iter().map(|cav| Party::new(Role::Agent, cav));
        let egos = [Role::Ego, Role::Link].map(|role| Party::new(role, &self.ego));
        let others = [Role::Replay, Role::Scorer, Role::Recorder, Role::Viewer].map(Party::alone);
        agents.chain(egos).chain(others).collect()
    }

    /// The keys of a run of this fleet, where its scenario asks for security.
    ///
    /// # Errors
    /// [`KeyError`] when they cannot be made.
    pub fn keys(&self, folder: &RunFolder) -> Result<Option<RunKeys>, KeyError> {
        let security = self.scenario.security.as_ref();
        security.map(|security| RunKeys::of(security, self.parties(), folder.path())).transpose()
    }

    /// Every process to start, the recorder last where the scenario asks for one.
    #[must_use]
    pub fn processes(&self, meeting: &Meeting<'_>) -> Vec<ProcessSpec> {
        let here = |cav: &&CavId| self.scenario.settings_of(cav).launch == Launch::Here;
        let mut specs: Vec<ProcessSpec> = self.agents.iter().filter(here).map(|cav| self.agent(cav, meeting)).collect();
        specs.push(self.ego_fuser(meeting));
        specs.extend(self.link(meeting));
        specs.push(self.replay(meeting));
        specs.extend(self.recorder(meeting));
        specs
    }

    /// The executables of a fleet.
    #[must_use]
    pub fn programs(programs: &Path) -> Vec<PathBuf> {
        ["agent", "ego-fuser", "sim-replay", "v2vloc"].iter().map(|name| programs.join(name)).collect()
    }

    /// What every process of this fleet is told.
    fn arguments(&self, command: &str, meeting: &Meeting<'_>) -> Arguments {
        let mut args = Arguments::of(command, meeting);
        let shared_memory_mib = self.scenario.network.shared_memory_mib;
        if shared_memory_mib > 0 {
            args.option("--shm-mib", &shared_memory_mib.to_string());
        }
        args
    }

    fn agent(&self, cav: &CavId, meeting: &Meeting<'_>) -> ProcessSpec {
        let settings = self.scenario.settings_of(cav);
        let mut args = self.arguments("run", meeting);
        args.option("--cav", cav.as_str());
        self.model(&mut args);
        args.option("--publish", self.publish().name());
        args.option("--pose-source", settings.pose.name());
        if let PoseSource::Noisy(noise) = settings.pose {
            args.option("--noise-mode", noise_mode(noise.mode));
            args.option("--noise-position-std", &noise.std_m.to_string());
            args.option("--noise-heading-std", &noise.std_deg.to_string());
            args.option("--noise-seed", &noise.seed.to_string());
        }
        if let (PoseSource::Pgc, Some(models)) = (&settings.pose, &self.scenario.models.localizer) {
            args.option("--encoder", &models.encoder);
            args.option("--head", &models.head);
        }
        if let (PoseSource::EndToEnd, Some(weights)) = (&settings.pose, &self.scenario.models.end_to_end) {
            args.option("--end-to-end", weights);
        }
        args.option("--dtype", dtype(settings.codec.dtype));
        // The vehicle of the ego sends to its own ego, which is to have all of its map.
        let gate = settings.codec.gate.or(self.scenario.method.gate()).filter(|_| *cav != self.ego);
        if let Some(gate) = gate {
            args.option("--gate", &gate.threshold.to_string());
            args.option("--gate-smoothing", &smoothing(gate.smoothing));
        }
        if let Some(bytes) = settings.codec.budget_bytes.filter(|_| *cav != self.ego) {
            args.option("--budget", &bytes.to_string());
        }
        if let Some(level) = settings.codec.zstd_level {
            args.option("--zstd", &level.to_string());
        }
        if let Some(lie) = settings.lie {
            args.option("--lie", &lie.name().replace('_', "-"));
        }
        // Nor does that map cross the air.
        if *cav != self.ego {
            rate_options(&mut args, &settings.rate);
        } else if self.scenario.clock == Clock::Wall {
            args.option("--sweep-log", &meeting.folder.file(SWEEP_LOG));
        }
        meeting.process(format!("agent-{cav}"), "agent", args, Life::Service)
    }

    fn ego_fuser(&self, meeting: &Meeting<'_>) -> ProcessSpec {
        let mut args = self.arguments("run", meeting);
        args.option("--ego", self.ego.as_str());
        self.model(&mut args);
        args.option("--method", self.scenario.method.name());
        args.option("--deadline-ms", &self.scenario.ego.deadline_ms.to_string());
        self.peers(&mut args);
        args.option("--comm-range", &self.protocol.ground_truth.comm_range_m.to_string());
        args.option("--max-age-ms", &self.scenario.ego.max_age_ms.to_string());
        if self.scenario.ego.trust {
            args.flag("--trust");
        }
        if self.is_over_link() {
            args.flag("--over-link");
        }
        meeting.process(format!("ego-{}", self.ego), "ego-fuser", args, Life::Service)
    }

    /// How much each vehicle may bring those who listen to it.
    fn peers(&self, args: &mut Arguments) {
        args.option("--peer-messages-per-s", &self.scenario.ego.peer_messages_per_s.to_string());
        args.option("--peer-mib-per-s", &self.scenario.ego.peer_mib_per_s.to_string());
    }

    /// The emulated air, where the scenario has one and the method sends anything through it.
    fn link(&self, meeting: &Meeting<'_>) -> Option<ProcessSpec> {
        let link = self.scenario.link.as_ref().filter(|_| self.is_over_link())?;
        let streams = [Stream::Pose, self.publish().stream(), Stream::Descriptor].map(|stream| stream.to_string());
        let mut args = self.arguments("link", meeting);
        args.option("--ego", self.ego.as_str());
        args.option("--link", &link.air);
        args.option("--seed", &link.seed.to_string());
        args.option("--streams", &streams.join(","));
        self.peers(&mut args);
        Some(meeting.process(format!("link-{}", self.ego), "sim-replay", args, Life::Service))
    }

    fn is_over_link(&self) -> bool {
        self.scenario.link.is_some() && self.scenario.method.exchange() != Exchange::Nothing
    }

    fn neighbours(&self) -> impl Iterator<Item = &CavId> {
        self.agents.iter().filter(|cav| **cav != self.ego)
    }

    fn replay(&self, meeting: &Meeting<'_>) -> ProcessSpec {
        let scene = &self.scenario.scene;
        let mut args = self.arguments("stream", meeting);
        args.0.push(scene.dir.clone().into());
        if let Some(name) = &scene.scenario {
            args.option("--scenario", name);
        }
        let agents: Vec<&str> = self.agents.iter().map(CavId::as_str).collect();
        args.option("--agents", &agents.join(","));
        if let Some(variant) = &scene.variant {
            args.option("--variant", variant);
        }
        args.option("--rate", &scene.rate.to_string());
        args.option("--seek", &scene.seek.to_string());
        if let Some(frames) = scene.frames {
            args.option("--frames", &frames.to_string());
        }
        if scene.repeat {
            args.flag("--loop");
        }
        if scene.lockstep {
            args.option("--lockstep", self.ego.as_str());
        }
        for route in self.recorded(self.routes()) {
            args.option("--expect", &route.to_string());
        }
        args.option("--ready-timeout", &self.scenario.timeouts.ready_s.to_string());
        args.option("--bookmark", &meeting.folder.file(BOOKMARK));
        meeting.process(REPLAY.into(), "sim-replay", args, Life::Task)
    }

    fn recorder(&self, meeting: &Meeting<'_>) -> Option<ProcessSpec> {
        let record = self.scenario.record.as_ref()?;
        let mut args = self.arguments("record", meeting);
        args.option("--out", &meeting.folder.file(RECORDING));
        if !record.without.is_empty() {
            let without: Vec<String> = record.without.iter().map(ToString::to_string).collect();
            args.option("--without", &without.join(","));
        }
        if let Some(level) = record.zstd_level {
            args.option("--zstd", &level.to_string());
        }
        args.flag("--json");
        // A recording cannot be taken up in the middle.
        Some(meeting.process(RECORDER.into(), "sim-replay", args, Life::Optional))
    }

    /// What every vehicle puts on the air beside its pose.
    pub(crate) fn publish(&self) -> Publish {
        Publish::for_method(self.scenario.method)
    }

    fn model(&self, args: &mut Arguments) {
        args.option("--weights", &self.scenario.models.weights);
        args.option("--threads", &self.scenario.models.threads.to_string());
    }
}
