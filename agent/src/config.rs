//! Configuration of `agent run`: one type for file, options and JSON schema.

use std::num::ParseIntError;
use std::path::PathBuf;
use std::str::FromStr;

use bus::{BusConfig, ProcessConfig};
use protocol::codec::{HEAD_BYTES, smallest_message};
use protocol::config::{FieldError, within};
use protocol::{BevFeatures, CavId, CodecConfig, ConfidenceGate, RunId, Stream};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use crate::agent_loop::LoopOptions;
use crate::attack::Falsification;
use crate::node::NodeOptions;
use crate::rate::{LONGEST_TRANSMISSION_NANOS, RateConfig};
use localization::pose_source::PoseSourceConfig;
use perception::compute_device::ComputeDevice;
use perception::detector::Detector;
use perception::inference::Inference;
use perception::int8::InferencePrecision;
use perception::weights::{FileError, Weights};

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
    /// Messages to publish beside the pose; with none the agent needs no detector and computes poses only.
    #[arg(long, value_enum, value_delimiter = ',')]
    #[serde(default = "Publish::maps")]
    pub publish: Vec<Publish>,
    /// Egos whose pace the agent follows. Absent: all egos.
    #[arg(
        long,
        value_name = "ID",
        value_delimiter = ',',
        allow_hyphen_values = true
    )]
    #[serde(default)]
    pub egos: Vec<CavId>,
    /// Keep running when the replay ends, for the next one; always so with `supervised`.
    #[arg(long)]
    #[serde(default)]
    pub keep_running: bool,
    /// Log of the arrival of each sweep: capture time and arrival, nanoseconds.
    #[arg(long, value_name = "FILE")]
    #[serde(default)]
    pub sweep_log: Option<PathBuf>,
    /// Record everything that enters the agent's decisions into this file, for `agent replay-inputs`.
    #[arg(long, value_name = "FILE")]
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub inputs: Option<PathBuf>,
    /// Detector, threads and device.
    #[command(flatten)]
    #[serde(default)]
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
#[derive(Debug, Clone, PartialEq, Eq, Default, Serialize, Deserialize, JsonSchema, clap::Args)]
#[serde(default, deny_unknown_fields)]
pub struct ModelConfig {
    /// Weights of the detector (safetensors; its configuration is inside).
    #[arg(long, value_name = "FILE")]
    pub weights: PathBuf,
    /// Number format in which networks are computed.
    #[arg(long, value_enum, default_value_t)]
    pub precision: InferencePrecision,
    /// Threads that libtorch computes with, 1 to 256; the same number gives the same bits.
    #[arg(long)]
    pub threads: Threads,
    /// Device that the networks compute on; cuda needs a libtorch with CUDA and a CUDA device, and its results are
    /// slightly different.
    #[arg(long, value_enum)]
    pub device: ComputeDevice,
}

impl ModelConfig {
    /// Checks that the processes can compute as configured.
    ///
    /// # Errors
    /// [`FieldError`] for weights that are not named, a number of threads out of range, or a device that is missing.
    pub fn validate(&self) -> Result<(), FieldError> {
        if self.weights.as_os_str().is_empty() {
            let rule = "must name a file (--weights)";
            return Err(FieldError::new("models.weights", "empty", rule));
        }
        self.validate_without_weights()
    }

    fn validate_without_weights(&self) -> Result<(), FieldError> {
        self.threads.validate()?;
        self.inference().map(drop)
    }

    /// Reads the weights, to compute with as [`Self::inference`] says.
    ///
    /// # Errors
    /// [`FileError`] names the file.
    pub fn load(&self, inference: Inference) -> Result<Weights, FileError> {
        Ok(Weights::load(&self.weights)?.with_precision(inference.precision))
    }

    /// Device and number format of the networks.
    ///
    /// # Errors
    /// [`FieldError`] names what a device needs and this machine lacks.
    pub fn inference(&self) -> Result<Inference, FieldError> {
        let device = (self.device.open())
            .map_err(|missing| FieldError::new("models.device", "cuda", missing.to_string()))?;
        Ok(Inference::new(device, self.precision))
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
    /// Send detections in place of feature maps, or beside them: a kilobyte, of any network. The ego needs weights with a
    /// box input. Absent: maps alone.
    #[arg(long, value_enum)]
    #[serde(skip_serializing_if = "Option::is_none")]
    pub boxes: Option<SentBoxes>,
    /// Weights of a vehicle with a network of its own. Absent: those of the run, as always of the ego's own agent.
    #[arg(skip)]
    #[serde(skip_serializing_if = "Option::is_none")]
    pub weights: Option<PathBuf>,
    /// Falsification of the vehicle's messages, to measure its effect on the ego. Absent: none.
    #[arg(long, value_enum, help_heading = "Attack")]
    #[serde(skip_serializing_if = "Option::is_none")]
    pub falsification: Option<Falsification>,
}

/// Detections that a vehicle sends where the method fuses feature maps.
#[derive(
    Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema, clap::ValueEnum,
)]
#[serde(rename_all = "snake_case")]
pub enum SentBoxes {
    /// In place of maps.
    Only,
    /// Beside maps, and before them: the ego reads both, and boxes alone where a map is late, lost or of another network.
    Beside,
}

/// Place of a vehicle in a fleet.
#[derive(Debug, Clone, Copy)]
pub struct FleetPlace<'a> {
    /// Name of the recorded scenario.
    pub scenario: &'a str,
    /// Index among the vehicles of the fleet.
    pub index: usize,
    /// True for the vehicle of the ego.
    pub is_ego: bool,
    /// Gate of the method for feature maps without one.
    pub gate: Option<ConfidenceGate>,
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
    /// Nothing: poses only.
    None,
}

impl Publish {
    fn maps() -> Vec<Self> {
        vec![Self::Bev]
    }

    /// Stream of these messages.
    fn stream(self) -> Option<Stream> {
        match self {
            Self::Bev => Some(Stream::Bev),
            Self::Boxes => Some(Stream::Boxes),
            Self::Points => Some(Stream::Points),
            Self::None => None,
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
    /// Settings of one vehicle of a fleet, the same on every clock and in evaluations.
    ///
    /// Tracked vehicles measure in turn. Some pose errors spare the ego ([`PoseSourceConfig::for_ego`]). Its own agent
    /// sends over no link: its map is neither restricted nor adapted.
    pub fn in_fleet(self, place: FleetPlace<'_>) -> Self {
        let turn = u32::try_from(place.index).unwrap_or(u32::MAX);
        let pose = self.pose.for_scenario(place.scenario).with_turn(turn);
        let codec = self.codec;
        if !place.is_ego {
            let gate = codec.gate.or(place.gate);
            return Self {
                pose,
                codec: CodecConfig { gate, ..codec },
                ..self
            };
        }
        Self {
            pose: pose.for_ego(),
            codec: CodecConfig {
                gate: None,
                budget_bytes: None,
                ..codec
            },
            rate: RateConfig::default(),
            boxes: None,
            weights: None,
            ..self
        }
    }

    /// Checks the values.
    ///
    /// # Errors
    /// [`FieldError`] of the first value that is out of range.
    pub fn validate(&self) -> Result<(), FieldError> {
        self.pose.validate()?;
        self.codec.validate()
    }

    /// Checks that an attack has something to falsify among the streams that are sent, and something to copy: the
    /// messages of other vehicles, which none in a `process` of its own gets.
    ///
    /// # Errors
    /// [`FieldError`] when it has nothing.
    pub fn check_attack(&self, sent: &[Stream], process: bool) -> Result<(), FieldError> {
        let (attack, rule) = match self.falsification {
            Some(attack @ Falsification::FalseVelocity) if !sent.contains(&Stream::Boxes) => (
                attack,
                "needs boxes, which state velocities: the vehicle sends none",
            ),
            Some(attack @ Falsification::Copied) if process => (
                attack,
                "must be another: it copies vehicles of the same process (clock: stepped without processes)",
            ),
            _ => return Ok(()),
        };
        Err(FieldError::new("agents.falsification", attack.name(), rule))
    }

    /// Checks that a feature map of this network is within the byte limits at least without cells.
    ///
    /// # Errors
    /// [`FieldError`] of the first limit that is too small, with the smallest size.
    pub fn check_limits(&self, sent: &[Stream], detector: &Detector) -> Result<(), FieldError> {
        if !sent.contains(&Stream::Bev) {
            return Ok(());
        }
        let empty = BevFeatures {
            grid: detector.grid(),
            channels: u32::try_from(detector.sent_shape()[0]).unwrap_or(u32::MAX),
            code_of: None,
            values: Vec::new(),
        };
        // A map beyond the sender's own limits is refused where it is encoded.
        let smallest = smallest_message(&empty).unwrap_or(0);
        let (rate, a_second) = (self.rate, 1_000_000_000 / LONGEST_TRANSMISSION_NANOS);
        let limits = [
            (
                "codec.budget_bytes",
                self.codec.budget_bytes,
                smallest.saturating_sub(HEAD_BYTES),
            ),
            ("rate.message_bytes", rate.message_bytes, smallest),
            (
                "rate.bytes_per_second",
                rate.bytes_per_second,
                smallest * a_second,
            ),
        ];
        for (field, limit, smallest) in limits {
            if let Some(bytes) = limit.filter(|bytes| *bytes < smallest) {
                let rule = format!("must be at least {smallest}: a map without cells");
                return Err(FieldError::new(field, bytes, rule));
            }
        }
        Ok(())
    }

    /// Options of the loop of a vehicle that publishes these streams, and follows the pace of any ego.
    pub fn loop_options(&self, publish: Vec<Stream>) -> LoopOptions {
        LoopOptions {
            publish,
            codec: self.codec,
            rate: self.rate,
            egos: Vec::new(),
            falsification: self.falsification,
        }
    }

    /// Streams that the vehicle publishes where a method needs `needed`, in this order.
    pub fn sent_for(&self, needed: Stream) -> Vec<Stream> {
        match (needed, self.boxes) {
            (Stream::Bev, Some(SentBoxes::Only)) => vec![Stream::Boxes],
            (Stream::Bev, Some(SentBoxes::Beside)) => vec![Stream::Boxes, Stream::Bev],
            _ => vec![needed],
        }
    }
}

impl ProcessConfig for AgentConfig {
    const REQUIRED: &'static [&'static str] = &["run", "cav"];

    fn validate(&self) -> Result<(), FieldError> {
        if self.publish.contains(&Publish::None) && self.publish.len() > 1 {
            let rule = "must be alone: nothing is published beside the pose";
            return Err(FieldError::new("publish", "none and others", rule));
        }
        if let Some(weights) = &self.settings.weights {
            let rule = "must be left out: those of one agent are models.weights (--weights)";
            return Err(FieldError::new("settings.weights", weights.display(), rule));
        }
        let weights = self.models.weights.display();
        match self.gives_poses_only() {
            true if !self.models.weights.as_os_str().is_empty() => {
                let rule = "must be left out: poses only need no detector (--publish none)";
                return Err(FieldError::new("models.weights", weights, rule));
            }
            true => self.models.validate_without_weights()?,
            false => self.models.validate()?,
        }
        self.settings.validate()?;
        // Against the streams as they are sent: boxes may stand in for maps.
        self.settings
            .check_attack(&self.options().of_loop.publish, true)?;
        self.bus.validate()
    }
}

impl AgentConfig {
    /// True if the agent has no detector, since nothing that needs one is published.
    pub fn gives_poses_only(&self) -> bool {
        self.publish.iter().all(|publish| *publish == Publish::None)
    }

    /// Options of the agent's node.
    pub fn options(&self) -> NodeOptions {
        let streams = self.publish.iter().filter_map(|publish| publish.stream());
        let publish = streams.flat_map(|stream| self.settings.sent_for(stream));
        NodeOptions {
            of_loop: LoopOptions {
                egos: self.egos.clone(),
                ..self.settings.loop_options(publish.collect())
            },
            keeps_running: self.keep_running || self.bus.supervised,
            sweep_log: self.sweep_log.clone(),
            // The log holds the whole configuration: a replay builds the agent from it.
            inputs: (self.inputs.clone())
                .map(|path| (path, serde_json::to_string(self).unwrap_or_default())),
        }
    }
}

#[cfg(test)]
mod tests {
    use bus::minimal;
    use localization::pose_source::{NoiseMode, NoisyPoseConfig, TrackedPoseConfig};

    use super::*;

    fn in_fleet(pose: PoseSourceConfig, index: usize, is_ego: bool) -> AgentSettings {
        let settings = AgentSettings {
            pose,
            codec: CodecConfig {
                budget_bytes: Some(4000),
                ..CodecConfig::default()
            },
            ..AgentSettings::default()
        };
        settings.in_fleet(FleetPlace {
            scenario: "town1",
            index,
            is_ego,
            gate: None,
        })
    }

    #[test]
    fn a_fixed_error_spares_the_ego() {
        let [fixed, independent] = [NoiseMode::Fixed, NoiseMode::Independent].map(|mode| {
            PoseSourceConfig::Noisy(NoisyPoseConfig {
                mode,
                ..NoisyPoseConfig::default()
            })
        });
        let recorded = in_fleet(fixed.clone(), 0, true).pose;
        assert_eq!(recorded, PoseSourceConfig::Recorded);
        assert_eq!(in_fleet(fixed.clone(), 1, false).pose, fixed);
        let of_scenario = independent.for_scenario("town1");
        assert_eq!(in_fleet(independent.clone(), 0, true).pose, of_scenario);
        assert_ne!(of_scenario, independent, "errors of the scenario");
    }

    fn phase(settings: &AgentSettings) -> u32 {
        match &settings.pose {
            PoseSourceConfig::Tracked(tracked) => tracked.phase,
            other => panic!("{other:?}"),
        }
    }

    #[test]
    fn tracked_vehicles_measure_in_turn_and_the_map_of_the_ego_is_whole() {
        let tracked = PoseSourceConfig::Tracked(TrackedPoseConfig::default());
        let [ego, neighbour] =
            [(2, true), (3, false)].map(|(index, is_ego)| in_fleet(tracked.clone(), index, is_ego));
        assert_eq!(
            (ego.codec.budget_bytes, neighbour.codec.budget_bytes),
            (None, Some(4000))
        );
        assert_eq!((phase(&ego), phase(&neighbour)), (2, 3));
    }

    fn config(publish: &[Publish]) -> AgentConfig {
        AgentConfig {
            publish: publish.to_vec(),
            ..minimal(|_| "x".into()).unwrap()
        }
    }

    #[test]
    fn the_configuration_of_a_robot_is_one_of_poses_only() {
        let file = concat!(env!("CARGO_MANIFEST_DIR"), "/../deploy/ros2/agent.yaml");
        let config: AgentConfig = support::config_file::read(file.as_ref()).unwrap();
        config.validate().unwrap();
        assert!(config.gives_poses_only());
        assert_eq!(config.settings.pose.name(), "tracked");
    }

    #[test]
    fn an_agent_that_publishes_nothing_beside_the_pose_needs_no_weights() {
        for publish in [&[Publish::None][..], &[]] {
            let config = config(publish);
            config.validate().unwrap();
            assert!(config.gives_poses_only() && config.options().of_loop.publish.is_empty());
        }
        let error = config(&[Publish::Bev]).validate().unwrap_err().to_string();
        assert_eq!(
            error,
            "models.weights is empty: must name a file (--weights)"
        );
        let error = config(&[Publish::None, Publish::Bev]).validate();
        assert!(error.unwrap_err().to_string().contains("must be alone"));
    }
}
