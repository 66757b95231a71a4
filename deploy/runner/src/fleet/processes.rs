//! Processes of a fleet: one resolved configuration each, written into the run folder.

use std::collections::BTreeSet;
use std::net::SocketAddr;
use std::path::{Path, PathBuf};

use agent::config::{AgentConfig, Publish};
use bus::{BusConfig, Endpoint};
use deploy::operate::run_folder::{CHECKPOINT, RECORDING, RunFolder, RunFolderError, SWEEP_LOG};
use deploy::operate::security::RunKeys;
use deploy::operate::supervise::{ProcessSpec, RestartPolicy};
use deploy::operate::{RECORDER, REPLAY};
use ego_fuser::config::{EgoConfig, EgoSettings, PaceMode};
use fusion::Exchange;
use protocol::{CavId, RunId, Stream};
use serde::Serialize;
use sim_replay::config::{
    LinkProcessConfig, LinkSelection, RecorderConfig, ReplayConfig, SensorLinkConfig, WaitConfig,
};
use support::random::scenario_seed;

use super::Fleet;
use crate::scenario::{Clock, Scenario};

/// Result of planning: a [`RunFolderError`] if nothing else is named.
type Result<T, E = RunFolderError> = std::result::Result<T, E>;

/// Session context of the processes: run, router endpoint, program folder and run folder.
#[derive(Debug, Clone)]
pub struct SessionContext<'a> {
    /// The run that they join.
    pub run: &'a RunId,
    /// Endpoint of the router.
    pub endpoint: Endpoint,
    /// Keys of the processes, if the run has security.
    pub keys: Option<&'a RunKeys>,
    /// Folder of the programs.
    pub programs: &'a Path,
    /// Folder of the run.
    pub folder: &'a RunFolder,
}

impl Fleet {
    /// Every process to start, the recorder last if the scenario asks for one. Writes their configurations.
    ///
    /// # Errors
    /// [`RunFolderError::Write`] when the run folder cannot be written.
    pub fn processes(&self, context: &SessionContext<'_>) -> Result<Vec<ProcessSpec>> {
        let mut planner = self.planner(context)?;
        let (ego, link) = (format!("ego-{}", self.ego), format!("link-{}", self.ego));
        planner.plan(ego, "ego-fuser run", RestartPolicy::Service, |bus| {
            self.ego_config(context, bus)
        })?;
        if self.is_over_link() {
            planner.plan(link, "sim-replay link", RestartPolicy::Service, |bus| {
                self.link_config(context, bus)
            })?;
        }
        let replay = REPLAY.to_owned();
        planner.plan(replay, "sim-replay stream", RestartPolicy::Task, |bus| {
            self.replay_config(context, bus)
        })?;
        if let Some(record) = &self.scenario.record {
            let (run, out) = (context.run.clone(), context.folder.file(RECORDING));
            // A recording cannot be resumed after an interruption.
            let life = RestartPolicy::Optional;
            planner.plan(RECORDER.into(), "sim-replay record --json", life, |bus| {
                RecorderConfig {
                    run,
                    out,
                    record: record.clone(),
                    keep_running: false,
                    bus,
                }
            })?;
        }
        Ok(planner.specs)
    }

    /// A plan of the agents that this run starts, for further processes. Writes their configurations.
    ///
    /// # Errors
    /// [`RunFolderError::Write`] when the run folder cannot be written.
    pub(crate) fn planner<'a>(&self, context: &'a SessionContext<'a>) -> Result<Planner<'a>> {
        let wanted_mib = self.scenario.network.shared_memory_mib;
        // At most: agents, ego and replay, and link and recorder where there are such.
        let recorders = usize::from(self.scenario.record.is_some());
        let processes = self.agents.len() + 2 + usize::from(self.is_over_link()) + recorders;
        let bus = BusConfig {
            connect: context.endpoint.clone(),
            shared_memory_mib: pool_mib(wanted_mib, processes),
            supervised: true,
            ..BusConfig::default()
        };
        let mut planner = Planner {
            context,
            bus,
            metrics: self.scenario.network.metrics,
            specs: Vec::new(),
        };
        let remote = &self.scenario.remote_agents;
        for cav in self.agents.iter().filter(|cav| !remote.contains(cav)) {
            let name = format!("agent-{cav}");
            planner.plan(name, "agent run", RestartPolicy::Service, |bus| {
                self.agent_config(cav, context, bus)
            })?;
        }
        Ok(planner)
    }

    fn agent_config(
        &self,
        cav: &CavId,
        context: &SessionContext<'_>,
        bus: BusConfig,
    ) -> AgentConfig {
        let mut settings = self.settings_of(cav);
        let mut models = self.scenario.models.clone();
        if let Some(weights) = settings.weights.take() {
            models.weights = weights;
        }
        // Sweeps arrive on the wall clock only, and frames.csv has those of the ego alone.
        let notes_sweeps = *cav == self.ego && self.scenario.clock == Clock::Wall;
        AgentConfig {
            run: context.run.clone(),
            cav: cav.clone(),
            models,
            settings,
            publish: vec![match self.needed() {
                Exchange::Nothing | Exchange::Features => Publish::Bev,
                Exchange::Boxes => Publish::Boxes,
                Exchange::Points => Publish::Points,
            }],
            egos: vec![self.ego.clone()],
            keep_running: false,
            sweep_log: notes_sweeps.then(|| context.folder.file(SWEEP_LOG)),
            inputs: self.inputs(context, &format!("agent-{cav}")),
            bus,
        }
    }

    fn ego_config(&self, context: &SessionContext<'_>, bus: BusConfig) -> EgoConfig {
        EgoConfig {
            run: context.run.clone(),
            models: self.scenario.models.clone(),
            method: Some(self.scenario.method),
            ego: ego_settings(&self.scenario),
            neighbours: Vec::new(),
            comm_range_m: self.protocol.ground_truth.comm_range_m,
            over_link: self.is_over_link(),
            keep_running: false,
            inputs: self.inputs(context, &format!("ego-{}", self.ego)),
            bus,
        }
    }

    /// File for the inputs of a process's decisions, if they are recorded.
    fn inputs(&self, context: &SessionContext<'_>, process: &str) -> Option<PathBuf> {
        let record = self.scenario.record.as_ref();
        let is_recorded = record.is_some_and(|record| record.inputs);
        is_recorded.then(|| context.folder.file(&format!("inputs-{process}.log")))
    }

    fn link_config(&self, context: &SessionContext<'_>, bus: BusConfig) -> LinkProcessConfig {
        let contents = self.neighbours().flat_map(|cav| self.streams_of(cav));
        let contents: BTreeSet<Stream> = contents.collect();
        let streams = [Stream::Pose].into_iter().chain(contents);
        let link = self.scenario.link.clone().unwrap_or_default();
        LinkProcessConfig {
            run: context.run.clone(),
            ego: self.ego.clone(),
            link: LinkSelection {
                seed: scenario_seed(link.seed, &self.recorded.name),
                ..link
            },
            streams: streams.chain([Stream::Descriptor]).collect(),
            keep_running: false,
            inbox: self.scenario.ego.inbox,
            bus,
        }
    }

    fn replay_config(&self, context: &SessionContext<'_>, bus: BusConfig) -> ReplayConfig {
        let scene = &self.scenario.scene;
        ReplayConfig {
            run: context.run.clone(),
            scene: scene.clone(),
            // The clock starts when every route exists, or the first messages would reach nobody.
            wait: WaitConfig {
                expect: self.recorded(self.routes()),
                ready_timeout_s: self.scenario.timeouts.ready_s,
                egos: Vec::from_iter(scene.lockstep.then(|| self.ego.clone())),
                ..WaitConfig::default()
            },
            sensor_link: SensorLinkConfig::default(),
            checkpoint: Some(context.folder.file(CHECKPOINT)),
            bus,
        }
    }

    /// True if the scenario emulates a link and the method sends anything through it.
    pub(super) fn is_over_link(&self) -> bool {
        self.scenario.link.is_some() && self.scenario.method.exchange() != Exchange::Nothing
    }
}

/// Processes planned so far, and the settings that the next one shares with them.
pub(crate) struct Planner<'a> {
    context: &'a SessionContext<'a>,
    bus: BusConfig,
    /// Metrics address of the previous process; the next one takes the port after it.
    metrics: Option<SocketAddr>,
    /// The processes.
    pub(crate) specs: Vec<ProcessSpec>,
}

impl Planner<'_> {
    /// Writes the configuration of a process; `command` is its program, subcommand and output format.
    fn plan<C: Serialize>(
        &mut self,
        name: String,
        command: &str,
        life: RestartPolicy,
        config: impl FnOnce(BusConfig) -> C,
    ) -> Result<()> {
        self.metrics = self.metrics.and_then(|previous| {
            let port = previous.port().checked_add(1)?;
            Some(SocketAddr::new(previous.ip(), port))
        });
        let bus = BusConfig {
            keys: self.context.keys.map(|keys| keys.of_process(&name)),
            metrics: self.metrics,
            ..self.bus.clone()
        };
        let file = self.context.folder.write_config(&name, &config(bus))?;
        let mut parts = command.split(' ');
        let program = self.context.programs.join(parts.next().unwrap_or_default());
        let mut args: Vec<_> = parts.map(Into::into).collect();
        args.extend(["--config".into(), file.into()]);
        self.specs.push(ProcessSpec {
            name,
            program,
            args,
            life,
            metrics: self.metrics,
        });
        Ok(())
    }
}

/// Settings of the ego. In lockstep every tick is answered, which a pace would leave unanswered until the timeout.
fn ego_settings(scenario: &Scenario) -> EgoSettings {
    let mut settings = scenario.ego.clone();
    if scenario.scene.lockstep {
        settings.pace = PaceMode::EverySweep;
    }
    settings
}

/// Pool of each of some processes, MiB: the `wanted` one, or 0 with a warning where the system has no room for all.
fn pool_mib(wanted: usize, processes: usize) -> usize {
    match bus::check_room(wanted.saturating_mul(processes << 20)) {
        Ok(()) => wanted,
        Err(error) => {
            tracing::warn!(
                "network.shared_memory_mib {wanted}: messages of {processes} processes take the socket: {error}"
            );
            0
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn in_lockstep_the_ego_asks_for_every_sweep() {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("s.yaml");
        for (lockstep, pace) in [(true, PaceMode::EverySweep), (false, PaceMode::Auto)] {
            let text = format!("scene: {{dir: ., lockstep: {lockstep}}}\nmodels: {{weights: .}}\n");
            std::fs::write(&file, text).unwrap();
            let scenario = Scenario::read(&file).unwrap();
            assert_eq!(ego_settings(&scenario).pace, pace, "lockstep {lockstep}");
        }
    }

    #[test]
    fn where_not_all_pools_have_room_messages_take_the_socket() {
        assert_eq!([pool_mib(0, 4), pool_mib(1, 4)], [0, 1]);
        assert_eq!(pool_mib(usize::MAX >> 22, 4), 0);
    }
}
