//! Fleet of a scenario: its vehicles, its processes, and the configuration of each.

mod processes;
mod routes;
mod setup;

use std::path::{Path, PathBuf};

use agent::config::{AgentSettings, FleetPlace};
use anyhow::{Context, Result, anyhow, bail, ensure};
use dataset::evaluation_protocol::EvaluationProtocol;
use dataset::{self, LeftOut, OpenOptions, Problem, Scenario as Recorded, findings};
use deploy::operate::keys::{KeyFileError, principals_of};
use deploy::operate::run_folder::RunFolder;
use deploy::operate::security::RunKeys;
use ego_fuser::ego::Ego;
use fusion::Exchange;
use link::{LinkConfig, LinkEmulator};
use perception::inference::Inference;
use perception::model_config::DetectorConfig;
use perception::weights::Weights;
use protocol::{CavId, Stream};
use sim_replay::config::SceneConfig;
use support::file_digests::FileDigests;
use support::provenance::Provenance;
use tch::Device;

pub use self::processes::SessionContext;
use crate::cached_poses;
use crate::scenario::Scenario;
use crate::scenario::fingerprint::files_of;
use crate::scenario::weights_choice::weights_of;

/// The program that runs fleets.
pub(crate) const RUNNER: &str = "v2vloc-runner";

/// A scenario in which every open setting is filled in.
#[derive(Debug, Clone)]
pub struct Fleet {
    /// The scenario, with scene and vehicles named.
    pub scenario: Scenario,
    /// Every vehicle that takes part, in the scene's order.
    pub agents: Vec<CavId>,
    /// The fusing vehicle.
    pub ego: CavId,
    /// Number of ticks to play; `None`: until the run is ended.
    pub ticks: Option<usize>,
    /// The recorded scenario, with all its vehicles.
    pub recorded: Recorded,
    /// Configuration of the model, from its weights.
    pub detector: DetectorConfig,
    /// Evaluation protocol of the run.
    pub protocol: EvaluationProtocol,
    /// Findings about what is played.
    pub findings: Vec<Problem>,
    /// The same, and the files of the data set that cannot be used.
    pub left_out: LeftOut,
}

/// Loads what the processes of a scenario load, so that faulty weights and links are refused before any starts; returns
/// the configuration of the detector.
fn load_models(scenario: &Scenario) -> Result<DetectorConfig> {
    let weights = &scenario.models.weights;
    let weights = Weights::load(weights).context("weights")?;
    let detector = weights.detector_config().context("weights")?;
    // As the ego-fuser does: weights of another method are refused.
    Ego::from_weights(&weights, Some(scenario.method), Device::Cpu).context("weights")?;
    // Every vehicle loads the networks of its pose source for itself; errors are better reported once.
    let poses = scenario.poses();
    let mut networks = poses.iter().filter(|pose| pose.looks_at_sweeps());
    let loaded = networks.try_for_each(|pose| pose.build(Inference::default()).map(drop));
    loaded.context("localizer")?;
    if let Some(link) = &scenario.link {
        LinkEmulator::open(&link.model, link.seed)?;
    }
    Ok(detector)
}

/// Refuses pose sources that need measured poses, of vehicles of which the recorded scenario has none at any tick.
fn check_poses(scenario: &Scenario, recorded: &Recorded, agents: &[CavId]) -> Result<()> {
    let (name, ticks) = (&recorded.name, scenario.scene.seek..recorded.ticks.len());
    for cav in agents {
        let pose = scenario.settings_of(cav).pose;
        let place = recorded.agents.iter().position(|known| known == cav);
        ensure!(
            !pose.needs_measured_pose()
                || place
                    .is_none_or(|place| ticks.clone().any(|tick| recorded.has_poses(place, tick))),
            "vehicle {cav}: pose is {}, but scenario {name} has no poses of it (no lidar_pose); choose pose: pgc, \
             which finds them",
            pose.name()
        );
    }
    Ok(())
}

impl Fleet {
    /// Reads scene and weights.
    ///
    /// # Errors
    /// An error that names what the scene or the weights lack.
    pub fn plan(scenario: &Scenario) -> Result<Self> {
        let mut scenario = scenario.clone();
        let weights = &scenario.models.weights;
        scenario.models.weights = weights_of(weights, scenario.method, scenario.sends_boxes())?;
        let detector = load_models(&scenario)?;
        let scene = &scenario.scene;
        let options = OpenOptions::with_intensity_scale(scene.intensity_scale);
        let dataset = dataset::open_with(&scene.dir, &options).context("scene")?;
        // Refuses options of a protocol that a live run takes from other fields.
        for (option, is_given) in [
            ("agent_kinds", scenario.protocol.agent_kinds.is_some()),
            ("ego_kind", scenario.protocol.ego_kind.is_some()),
            ("max_agents", scenario.protocol.max_agents.is_some()),
        ] {
            ensure!(
                !is_given,
                "protocol: {option}: choose by scene.agents and ego.id instead"
            );
        }
        let protocol = scenario.protocol.resolve(dataset.layout);
        let mut protocol = protocol.map_err(|error| anyhow!("protocol: {error}"))?;
        let recorded = scenario_of(&dataset.scenarios, scene)?;
        // Refuses vehicles that the recorded scenario does not have.
        let in_scene = scene.agents.iter().map(|cav| ("scene.agents", cav));
        let egos = scenario.ego.id.iter().map(|cav| ("ego.id", cav));
        let own = scenario.vehicles.keys().map(|cav| ("vehicles", cav));
        let remote = scenario.remote_agents.iter();
        let remote = remote.map(|cav| ("remote_agents", cav));
        let mut named = in_scene.chain(egos).chain(own).chain(remote);
        if let Some((field, cav)) = named.find(|(_, cav)| !recorded.agents.contains(cav)) {
            let (name, found) = (&recorded.name, texts(&recorded.agents));
            bail!("{field} names vehicle {cav}, but scenario {name} has {found:?}");
        }
        // An empty list stands for the agents of the protocol; an ego that is named takes part too.
        let arranged = protocol.arrange(recorded);
        let named = match &scene.agents[..] {
            [] => arranged.clone().map(|of| of.agents).with_context(|| {
                let (protocol, name) = (&protocol.name, &recorded.name);
                format!("protocol {protocol}: scenario {name} has no agent or no ego of its kinds")
            })?,
            named => named.to_vec(),
        };
        let mut agents = recorded.agents.clone();
        agents.retain(|cav| named.contains(cav) || scenario.ego.id.as_ref() == Some(cav));
        // What is printed is what runs, also where more are named.
        protocol.max_agents = protocol.max_agents.max(agents.len());
        let ego = scenario.ego.id.clone().or_else(|| agents.first().cloned());
        let ego = ego.with_context(|| {
            let (name, found) = (&protocol.name, texts(&recorded.agents));
            format!("protocol {name}: none of the agents {found:?} is of a kind that takes part")
        })?;
        check_poses(&scenario, recorded, &agents)?;
        for pose in scenario.poses() {
            cached_poses::check(&pose, [recorded].into_iter(), &FileDigests::default())?;
        }
        let scene = &mut scenario.scene;
        // No underflow: scenario_of has refused a seek beyond the last tick.
        let left = recorded.ticks.len() - scene.seek;
        // A repeated scene has no last tick of its own.
        let ticks = if scene.repeat {
            scene.frames
        } else {
            Some(scene.frames.map_or(left, |frames| frames.min(left)))
        };
        // As in an evaluation: of the agents of the protocol, at the ticks until the end.
        let mut sampled = arranged.unwrap_or_else(|| recorded.clone());
        let frames = scene.frames.unwrap_or(usize::MAX);
        sampled.ticks.truncate(scene.seek.saturating_add(frames));
        let (scale, rule) = (scene.intensity_scale, &protocol.ground_truth);
        let findings = findings::sampled(&[sampled], scale, Some(rule));
        let mut left_out = LeftOut::default();
        left_out.add_files(&dataset.problems);
        left_out.add_findings(findings.clone());
        // What the file left open is filled in, so that the scenario.yaml of the run is complete.
        scene.scenario = Some(recorded.name.clone());
        scene.agents.clone_from(&agents);
        scenario.ego.id = Some(ego.clone());
        Ok(Self {
            scenario,
            agents,
            ego,
            ticks,
            recorded: recorded.clone(),
            detector,
            protocol,
            findings,
            left_out,
        })
    }

    /// The protocol with the ground-truth range as it is applied to the model: counted are its objects inside the area of
    /// the model.
    pub(crate) fn applied_protocol(&self) -> EvaluationProtocol {
        self.protocol.within(self.detector.lidar_range_m)
    }

    /// Number of values in one feature map of the model, as transmitted.
    pub(crate) fn map_values(&self) -> u64 {
        self.detector.feature_grid().cells() as u64 * self.detector.sent_channels() as u64
    }

    /// Settings of a vehicle, for its process and for simulation time alike.
    pub(crate) fn settings_of(&self, cav: &CavId) -> AgentSettings {
        let index = self.agents.iter().position(|agent| agent == cav);
        self.scenario.settings_of(cav).in_fleet(FleetPlace {
            scenario: self.scenario.scene.scenario.as_deref().unwrap_or_default(),
            index: index.unwrap_or_default(),
            is_ego: *cav == self.ego,
            gate: self.scenario.method.gate(),
        })
    }

    /// Name of the pose source that all vehicles share, or `mixed`.
    pub fn pose_source(&self) -> &'static str {
        let settings = self.agents.iter().map(|cav| self.scenario.settings_of(cav));
        let mut names = settings.map(|settings| settings.pose.name());
        let first = names.next().unwrap_or("recorded");
        match names.all(|name| name == first) {
            true => first,
            false => "mixed",
        }
    }

    /// Keys of a run of this fleet, if its scenario asks for security.
    ///
    /// # Errors
    /// [`KeyFileError`] when they cannot be made.
    pub fn keys(&self, folder: &RunFolder) -> Result<Option<RunKeys>, KeyFileError> {
        let security = self.scenario.security.as_ref();
        let keys = security.map(|of| {
            // Of every process that the run may have.
            let principals = principals_of(&self.agents, std::slice::from_ref(&self.ego)).concat();
            RunKeys::of(of, principals, folder.path())
        });
        keys.transpose()
    }

    /// Digests of the programs, and of all files that the run reads; the first file that cannot be read is a warning.
    pub(crate) fn provenance(&self, programs: &Path) -> Option<Provenance> {
        let (scenario, scene) = (&self.scenario, &self.scenario.scene);
        let vehicles = self.agents.iter().map(|cav| self.settings_of(cav));
        let vehicles: Vec<_> = vehicles.collect();
        // Opened before, when the run was planned.
        let link = scenario.link.as_ref();
        let link = link.and_then(|link| LinkConfig::open(&link.model).ok());
        let link = link.as_ref().map(|(link, folder)| (link, folder.as_path()));
        let weights = scenario.models.weights.clone();
        let files = files_of(scenario.method, weights, &vehicles, link);
        // Only the frames and vehicles of the run are hashed: no others are read.
        let mut data = self.recorded.clone();
        data.agents.clone_from(&self.agents);
        data.ticks.drain(..scene.seek);
        data.ticks.truncate(scene.frames.unwrap_or(usize::MAX));
        let digests = FileDigests::default();
        let data_sha256 = dataset::content_sha256([&data], scene.variant.as_deref(), &digests);
        let (programs, commit) = (Self::programs(programs), env!("V2VLOC_COMMIT"));
        Provenance::collect(&programs, data_sha256, files, commit, &digests)
            .inspect_err(|error| tracing::warn!("no hashes of what the run read: {error}"))
            .ok()
    }

    /// Executables of a fleet.
    pub fn programs(programs: &Path) -> Vec<PathBuf> {
        let names = ["agent", "ego-fuser", "sim-replay", "v2vloc", RUNNER];
        names.map(|name| programs.join(name)).into()
    }

    fn neighbours(&self) -> impl Iterator<Item = &CavId> {
        self.agents.iter().filter(|cav| **cav != self.ego)
    }

    /// Messages that the method needs; the ego's own agent sends its feature map even where no other counts.
    pub(crate) fn needed(&self) -> Exchange {
        self.scenario.method.own_content()
    }

    /// Streams that a vehicle publishes in addition to its pose.
    pub(crate) fn streams_of(&self, cav: &CavId) -> Vec<Stream> {
        self.settings_of(cav).sent_for(self.needed().stream())
    }
}

/// The scenario of a data set that a scene names, or the first. Refuses one without a frame to play.
fn scenario_of<'a>(scenarios: &'a [Recorded], scene: &SceneConfig) -> Result<&'a Recorded> {
    let dir = scene.dir.display();
    let recorded = match &scene.scenario {
        None => scenarios
            .first()
            .with_context(|| format!("scene {dir}: there is no scenario in it"))?,
        Some(asked) => scenarios
            .iter()
            .find(|known| known.name == *asked)
            .with_context(|| {
                let found: Vec<_> = scenarios.iter().map(|known| &known.name).collect();
                format!("scene {dir}: there is no scenario {asked:?}; it has {found:?}")
            })?,
    };
    let (name, seek, ticks) = (&recorded.name, scene.seek, recorded.ticks.len());
    let agents = texts(&recorded.agents);
    ensure!(
        ticks > 0,
        "scene {dir}: scenario {name} has no frame that all of {agents:?} have"
    );
    ensure!(
        seek < ticks,
        "scene.seek is {seek}, but scenario {name} has {ticks} ticks"
    );
    let (asked, known) = (scene.variant.as_ref(), &recorded.lidar_variants);
    if let Some(asked) = asked.filter(|asked| !known.contains(asked)) {
        bail!("scene.variant is {asked:?}, but scenario {name} has {known:?}");
    }
    Ok(recorded)
}

fn texts(agents: &[CavId]) -> Vec<String> {
    agents.iter().map(ToString::to_string).collect()
}

/// Sentence about weights that `vehicles` gives the ego: it has those of `models`.
pub(crate) fn unused_weights(scenario: &Scenario, ego: &CavId) -> Option<String> {
    let own = scenario.vehicles.get(ego)?.over(&AgentSettings::default());
    let weights = own.weights?;
    let field = format!("vehicles.{ego}.weights is {}", weights.display());
    Some(format!(
        "without effect: {field}, but the ego has those of models"
    ))
}

/// Sentence about the ticks of a scene at which the recording has no frame of the ego: they are none of the run's. Of a
/// repeated scene those of one lap.
pub(crate) fn ticks_without_ego(
    recorded: &Recorded,
    ego: &CavId,
    scene: &SceneConfig,
) -> Option<String> {
    let place = recorded.agents.iter().position(|cav| cav == ego)?;
    let ticks = (scene.seek..recorded.ticks.len()).take(scene.frames.unwrap_or(usize::MAX));
    let absent = ticks.filter(|tick| !recorded.is_present(place, *tick));
    let (name, absent) = (&recorded.name, absent.count());
    (absent > 0).then(|| {
        format!("scenario {name}: no frame of the ego {ego} at {absent} ticks, which do not count")
    })
}

#[cfg(test)]
mod tests {
    use std::fs;

    use super::*;

    #[test]
    fn weights_of_the_ego_as_one_of_the_vehicles_are_named() {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("s.yaml");
        let text = "scene: {dir: .}\nmodels: {weights: .}\nvehicles: {a: {weights: w}}\n";
        fs::write(&file, text).unwrap();
        let scenario = Scenario::read(&file).unwrap();
        let [of_ego, of_other] =
            ["a", "b"].map(|ego| unused_weights(&scenario, &CavId::new(ego).unwrap()));
        let found = of_ego.unwrap();
        assert!(
            found.starts_with("without effect: vehicles.a.weights is "),
            "{found}"
        );
        assert_eq!(of_other, None);
    }

    #[test]
    fn ticks_at_which_the_recording_lacks_the_ego_are_named() {
        let folder = tempfile::tempdir().unwrap();
        for (agent, ticks) in [("1", &[0, 1, 2, 3][..]), ("2", &[0, 3])] {
            fs::create_dir(folder.path().join(agent)).unwrap();
            for tick in ticks {
                let sweep = folder.path().join(format!("{agent}/{tick:06}.pcd"));
                let pose = "lidar_pose: [0, 0, 2, 0, 0, 0]\nvehicles: {}\n";
                fs::write(sweep.with_extension("yaml"), pose).unwrap();
                fs::write(sweep, "").unwrap();
            }
        }
        let recorded = dataset::open(folder.path()).unwrap().scenarios.remove(0);
        let file = folder.path().join("s.yaml");
        fs::write(&file, "scene: {dir: .}\nmodels: {weights: .}\n").unwrap();
        let mut scene = Scenario::read(&file).unwrap().scene;
        let of = |ego, scene: &SceneConfig| {
            ticks_without_ego(&recorded, &CavId::new(ego).unwrap(), scene).unwrap_or_default()
        };
        assert_eq!(of("1", &scene), "");
        let all = of("2", &scene);
        assert!(all.contains("ego 2 at 2 ticks"), "{all}");
        (scene.seek, scene.frames) = (1, Some(1));
        let cut = of("2", &scene);
        assert!(cut.contains("ego 2 at 1 ticks"), "{cut}");
    }

    #[test]
    fn a_variant_that_the_scenario_does_not_have_is_refused() {
        let folder = tempfile::tempdir().unwrap();
        let (agent, file) = (folder.path().join("1"), folder.path().join("s.yaml"));
        fs::create_dir(&agent).unwrap();
        let pose = "lidar_pose: [0, 0, 2, 0, 0, 0]\nvehicles: {}\n";
        fs::write(agent.join("000000.yaml"), pose).unwrap();
        for sweep in ["000000.pcd", "000000_fog_0.060.pcd"] {
            fs::write(agent.join(sweep), "").unwrap();
        }
        let found = dataset::open(folder.path()).unwrap().scenarios;
        fs::write(&file, "scene: {dir: .}\nmodels: {weights: .}\n").unwrap();
        let mut scene = Scenario::read(&file).unwrap().scene;
        for variant in [None, Some("fog_0.060")] {
            scene.variant = variant.map(str::to_owned);
            scenario_of(&found, &scene).unwrap();
        }
        scene.variant = Some("fog".into());
        let problem = scenario_of(&found, &scene).unwrap_err().to_string();
        let expected = "scene.variant is \"fog\", but scenario";
        assert!(
            problem.starts_with(expected) && problem.ends_with("has [\"fog_0.060\"]"),
            "{problem}"
        );
    }
}
