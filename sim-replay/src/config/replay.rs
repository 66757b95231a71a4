//! Configuration of `sim-replay stream`.

use std::path::PathBuf;
use std::time::Duration;

use protocol::config::{FieldError, within};
use protocol::{CavId, RunId};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use super::SceneConfig;
use crate::stream::StreamOptions;
use bus::{BusConfig, ProcessConfig, Route};
use dataset::LoadOptions;
use link::{CapacityConfig, LatencyModel, LinkConfig, LossModel};

/// Configuration of `sim-replay stream`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema, clap::Args)]
#[serde(deny_unknown_fields)]
pub struct ReplayConfig {
    /// Name of the run: 1 to 32 characters of a-z, 0-9, '_' and '-'.
    #[arg(long, required_unless_present = "config")]
    pub run: RunId,
    /// Checkpoint: file to which the state of the replay is written after each tick, and from which it resumes if the
    /// file exists. It must be of a replay with the same seek, frames and loop that has not ended.
    #[arg(long, value_name = "FILE")]
    #[serde(default)]
    pub checkpoint: Option<PathBuf>,
    /// Recorded scene.
    #[command(flatten)]
    pub scene: SceneConfig,
    /// Processes that the clock waits for.
    #[command(flatten)]
    #[serde(default)]
    pub wait: WaitConfig,
    /// Link from sensors to agents.
    #[command(flatten)]
    #[serde(default)]
    pub sensor_link: SensorLinkConfig,
    /// Connection to the router.
    #[command(flatten)]
    #[serde(default)]
    pub bus: BusConfig,
}

/// Processes that the clock waits for.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema, clap::Args)]
#[serde(default, deny_unknown_fields)]
#[command(next_help_heading = "Waiting for others")]
pub struct WaitConfig {
    /// Wait for the vehicles' agents before the clock starts.
    #[arg(long)]
    pub await_agents: bool,
    /// A further route that must be up before the clock starts, TOPIC>PROCESS, for example 4288/bev>ego-4279;
    /// repeatable.
    #[arg(long, value_name = "ROUTE", allow_hyphen_values = true)]
    pub expect: Vec<Route>,
    /// Longest time to wait for all routes, seconds.
    #[arg(long, value_name = "S")]
    pub ready_timeout_s: f64,
    /// Egos whose detections of a tick are awaited in lockstep.
    #[arg(long, value_name = "IDS", value_delimiter = ',')]
    #[arg(allow_hyphen_values = true)]
    pub egos: Vec<CavId>,
    /// Longest time to wait for an ego's detections in lockstep, seconds; the tick then counts as unanswered.
    #[arg(long, value_name = "S")]
    pub answer_timeout_s: f64,
}

impl Default for WaitConfig {
    fn default() -> Self {
        Self {
            await_agents: true,
            expect: Vec::new(),
            ready_timeout_s: 60.0,
            egos: Vec::new(),
            answer_timeout_s: 60.0,
        }
    }
}

/// Link emulation for sensor frames on their way to the agents. Nothing set: none.
#[derive(
    Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize, JsonSchema, clap::Args,
)]
#[serde(default, deny_unknown_fields)]
#[command(next_help_heading = "Link from sensors to agents")]
pub struct SensorLinkConfig {
    /// Mean delay, milliseconds.
    #[arg(long, value_name = "MS")]
    pub latency_ms: Option<f64>,
    /// Standard deviation of the delay, milliseconds; the order of frames is kept. Needs `latency_ms`.
    #[arg(long, value_name = "MS")]
    pub jitter_ms: Option<f64>,
    /// Rate of each vehicle's link, Mbit/s.
    #[arg(long, value_name = "MBPS")]
    pub bandwidth_mbps: Option<f64>,
    /// Share of the frames that is lost, 0 to 1.
    #[arg(long, value_name = "SHARE")]
    pub loss: Option<f64>,
    /// Same seed, same delays and losses.
    #[arg(long)]
    pub seed: u64,
}

impl SensorLinkConfig {
    /// The stages of the link; `None` if nothing is set.
    pub fn stages(&self) -> Option<LinkConfig> {
        if self.latency_ms.is_none() && self.bandwidth_mbps.is_none() && self.loss.is_none() {
            return None;
        }
        let rate_mbps = self.bandwidth_mbps;
        Some(LinkConfig {
            latency: match (self.latency_ms, self.jitter_ms) {
                (None, _) => LatencyModel::None,
                (Some(mean_ms), None) => LatencyModel::ConstantMs(mean_ms),
                (Some(mean_ms), Some(std_ms)) => LatencyModel::Normal { mean_ms, std_ms },
            },
            capacity: rate_mbps.map_or(CapacityConfig::Unlimited, CapacityConfig::of_mbps),
            loss: self.loss.map_or(LossModel::None, LossModel::Bernoulli),
            // A vehicle's own bus does not reorder.
            keep_order: true,
            ..LinkConfig::default()
        })
    }
}

impl ProcessConfig for ReplayConfig {
    const REQUIRED: &'static [&'static str] = &["run", "scene.dir"];

    fn validate(&self) -> Result<(), FieldError> {
        self.scene.validate()?;
        let wait = &self.wait;
        within("wait.ready_timeout_s", wait.ready_timeout_s, 0.0, 1e6)?;
        within("wait.answer_timeout_s", wait.answer_timeout_s, 0.0, 1e6)?;
        if self.scene.lockstep && wait.egos.is_empty() {
            let rule = "must name the egos that scene.lockstep waits for";
            return Err(FieldError::new("wait.egos", "empty", rule));
        }
        let link = &self.sensor_link;
        if link.jitter_ms.is_some() && link.latency_ms.is_none() {
            let (field, rule) = ("sensor_link.latency_ms", "must be given with jitter_ms");
            return Err(FieldError::new(field, "absent", rule));
        }
        if link.seed != 0 && link.stages().is_none() {
            let rule = "must be left out without a link: give latency_ms, bandwidth_mbps or loss";
            return Err(FieldError::new("sensor_link.seed", link.seed, rule));
        }
        // `options` takes lockstep from the egos alone, so they must not be named without it.
        if let (false, [ego, ..]) = (self.scene.lockstep, &wait.egos[..]) {
            let rule = "must be left out unless scene.lockstep is true";
            return Err(FieldError::new("wait.egos", ego, rule));
        }
        self.bus.validate()
    }
}

impl ReplayConfig {
    /// The options of the replay.
    pub fn options(&self) -> StreamOptions {
        let (scene, wait, sensor_link) = (&self.scene, &self.wait, &self.sensor_link);
        let [ready_timeout, answer_timeout] = [wait.ready_timeout_s, wait.answer_timeout_s]
            .map(|seconds| Duration::try_from_secs_f64(seconds).unwrap_or(Duration::MAX));
        StreamOptions {
            agents: scene.agents.clone(),
            rate: scene.rate,
            repeats: scene.repeat,
            seek: scene.seek,
            frames: scene.frames,
            load: LoadOptions {
                lidar_variant: scene.variant.clone(),
                points: true,
                radar: scene.radar,
                cameras: scene.cameras,
            },
            await_agents: wait.await_agents,
            expect: wait.expect.clone(),
            ready_timeout,
            lockstep: wait.egos.clone(),
            answer_timeout,
            link: sensor_link.stages().map(|link| (link, sensor_link.seed)),
            checkpoint: self.checkpoint.clone(),
        }
    }
}
