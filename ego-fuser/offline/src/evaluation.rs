//! Offline evaluation: a method on recorded scenes, frame by frame, with the code and messages of a live run.
//!
//! Every vehicle runs an [`Agent`]; its messages are encoded, measured and decoded again; the [`Ego`] detects. Nothing
//! is lost, and nothing is late unless configured, so a live run at that pace gives the same boxes. With
//! [`Evaluator::with_link`] messages pass through the link emulation in simulation time ([`stepped`]).

pub mod alignment;
mod error;
mod participant;
mod sent;
pub mod stepped;
mod sweeps;

use std::collections::VecDeque;
use std::ops::ControlFlow;
use std::path::PathBuf;

use agent::agent::Agent;
use agent::attack::{Attack, AttackConfig};
use agent::config::{AgentSettings, FleetPlace};
use agent::rate::RateConfig;
use dataset::class_set::ClassSet;
use dataset::evaluation_protocol::EvaluationProtocol;
use dataset::frame::Frame;
use dataset::ground_truth::{GroundTruth, GroundTruthRule};
use dataset::{LeftOut, LoadOptions, Scenario};
use localization::pose_source::PoseSourceConfig;
use perception::detector::Detector;
use perception::inference::Inference;
use perception::int8::InferencePrecision;
use perception::model_config::DetectorConfig;
use perception::weights::Weights;
use protocol::message::{Detections, FusedNeighbour, SkippedNeighbour};
use protocol::{CavId, CodecConfig, Ledger, PoseEstimate, Stamp};
use tch::Device;

use ego_fuser::ego::{Ego, EgoOutput, Skipped, View};
use ego_fuser::misbehaviour::{MisbehaviourConfig, neighbour_states};
use fusion::method::{Exchange, Method};
use training::feature_store::MapSource;

pub use error::EvaluateError;
use participant::Participant;
use sent::{Sent, stamp, view};
use stepped::{RemotePool, SteppedConfig};
use sweeps::Sweep;

/// Configuration of an evaluation.
#[derive(Debug, Clone, Default)]
pub struct EvaluateConfig {
    /// Weights of encoder and head.
    pub weights: PathBuf,
    /// Number format in which networks are computed.
    pub precision: InferencePrecision,
    /// The method; absent: that of the weights.
    pub method: Option<Method>,
    /// Source of the vehicles' poses.
    pub pose_source: PoseSourceConfig,
    /// Encoding of maps; without a gate the method's own is used.
    pub codec: CodecConfig,
    /// Rate control of neighbours. There is no queue to observe here.
    pub rate: RateConfig,
    /// Evaluation protocol: agents whose messages and annotations count, and objects that count; absent: vehicles
    /// completely over the area of the network, of all agents within 70 m.
    pub protocol: Option<EvaluationProtocol>,
    /// Delay of neighbours' messages, nanoseconds: the ego fuses the newest that are at least this old.
    pub delay_nanos: u64,
    /// Attacking neighbours; absent: none.
    pub attack: Option<AttackConfig>,
    /// Misbehaviour detection of the ego; absent: off.
    pub trust: Option<MisbehaviourConfig>,
}

/// One frame of the ego with all data for its evaluation.
#[derive(Debug, Clone)]
pub struct EvaluatedFrame {
    /// Tick of the scenario.
    pub tick: usize,
    /// Sender and capture time of the result.
    pub stamp: Stamp,
    /// Detections that the ego would have published; without boxes if it has failed.
    pub result: Detections,
    /// Reason why the ego has no result; counted in [`Evaluator::left_out`].
    pub failure: Option<String>,
    /// The frames of all vehicles that take part, the ego first: true poses and annotations.
    pub frames: Vec<Frame>,
    /// Reported pose of each of them.
    pub poses: Vec<PoseEstimate>,
    /// Objects in the ego's LiDAR frame, and the range of those that count.
    pub truth: GroundTruth,
}

/// Messages of all neighbours at one tick; empty where none takes part.
#[derive(Debug)]
struct SentAtOnce {
    capture_nanos: u64,
    sent: Vec<Sent>,
}

/// Evaluates scenarios one after another.
#[derive(Debug)]
pub struct Evaluator {
    config: EvaluateConfig,
    weights: Weights,
    ego: Ego,
    rule: GroundTruthRule,
    /// Messages of the neighbours, oldest first; the first is the last that has arrived, or has not arrived yet.
    under_way: VecDeque<SentAtOnce>,
    maps: Option<MapSource>,
    /// Link emulation in simulation time; absent: immediate delivery, or a fixed delay.
    stepped: Option<SteppedConfig>,
    /// Processes that run the vehicles' pipelines; absent: this process.
    remote: Option<RemotePool>,
    ledger: Ledger,
    /// Data that could not be used.
    left_out: LeftOut,
    /// Bytes of all messages that neighbours handed to the link.
    sent_bytes: u64,
}

impl Evaluator {
    /// Reads the weights.
    ///
    /// # Errors
    /// [`EvaluateError`] names the file and what is wrong with it.
    pub fn new(config: EvaluateConfig) -> Result<Self, EvaluateError> {
        let weights = Weights::load(&config.weights)?.with_precision(config.precision);
        let ego = Ego::from_weights(&weights, config.method, Device::Cpu)?;
        let ego = ego.with_misbehaviour_detection(config.trust)?;
        let area = ego.detector().config();
        let rule = config.protocol.as_ref().map_or_else(
            || rule_for(area),
            |protocol| protocol.rule_within(area.lidar_range_m),
        );
        let ego = ego.with_comm_range(rule.comm_range_m);
        Ok(Self {
            weights,
            ego,
            rule,
            config,
            under_way: VecDeque::new(),
            maps: None,
            stepped: None,
            remote: None,
            ledger: Ledger::default(),
            left_out: LeftOut::default(),
            sent_bytes: 0,
        })
    }

    /// The same with messages that pass through the link emulation, in simulation time.
    #[must_use]
    pub fn with_link(self, stepped: SteppedConfig) -> Self {
        Self {
            stepped: Some(stepped),
            ..self
        }
    }

    /// Runs the vehicles' pipelines in processes of their own from now on, or in this one, where the link is emulated.
    /// The previous processes get no more sweeps.
    pub fn set_processes(&mut self, remote: Option<RemotePool>) {
        if let Some(before) = std::mem::replace(&mut self.remote, remote) {
            before.finish();
        }
    }

    /// The accounting of all messages on the link so far; empty without a link.
    #[must_use]
    pub fn ledger(&self) -> &Ledger {
        &self.ledger
    }

    /// Bytes of all messages that neighbours handed to the link so far, poses and headers included; 0 without a link.
    #[must_use]
    pub fn sent_bytes(&self) -> u64 {
        self.sent_bytes
    }

    /// The same with maps that its encoder computed before, stored at least as exactly as in messages: the messages are
    /// then the same.
    #[must_use]
    pub fn with_maps(self, maps: MapSource) -> Self {
        Self {
            maps: Some(maps),
            ..self
        }
    }

    /// The ego's pipeline.
    #[must_use]
    pub fn ego(&self) -> &Ego {
        &self.ego
    }

    /// The ego's pipeline, to change it.
    pub fn ego_mut(&mut self) -> &mut Ego {
        &mut self.ego
    }

    /// The protocol with the ground-truth rule that applies to this network; absent where none was configured.
    #[must_use]
    pub fn protocol(&self) -> Option<EvaluationProtocol> {
        let protocol = self.config.protocol.as_ref()?;
        Some(protocol.within(self.ego.detector().config().lidar_range_m))
    }

    /// Rule for the objects that count.
    #[must_use]
    pub fn rule(&self) -> &GroundTruthRule {
        &self.rule
    }

    /// Runs over a scenario, its first agent being the ego; `on_frame` may end it. Frames that cannot be read are left
    /// out and counted ([`Self::left_out`]): a neighbour's as if it were absent, the ego's with its whole tick. So are
    /// frames that cannot be computed, but a tick of the ego has no result then ([`EvaluatedFrame::failure`]).
    ///
    /// # Errors
    /// [`EvaluateError`] when the pipeline reports an error.
    pub fn run(
        &mut self,
        scenario: &Scenario,
        on_frame: &mut dyn FnMut(EvaluatedFrame) -> ControlFlow<()>,
    ) -> Result<ControlFlow<()>, EvaluateError> {
        self.ego.forget();
        self.under_way.clear();
        if let Some(stepped) = self.stepped.clone() {
            return stepped::run(self, &stepped, scenario, on_frame);
        }
        let points = self.needs_points();
        let load = LoadOptions {
            points,
            ..LoadOptions::default()
        };
        let mut participants = Vec::with_capacity(scenario.agents.len());
        for (index, cav) in scenario.agents.iter().enumerate() {
            let settings = self.settings(scenario, index);
            participants.push(self.participant(scenario, cav, &settings)?);
        }
        let places: Vec<usize> = (0..participants.len()).collect();
        for tick in 0..scenario.ticks.len() {
            let sweeps = self.sweeps(scenario, tick, &places, &load, |_| true)?;
            if sweeps.first().is_none_or(|ego| ego.place != 0) {
                continue;
            }
            if on_frame(self.frame(scenario, &mut participants, sweeps, tick)?).is_break() {
                return Ok(ControlFlow::Break(()));
            }
        }
        Ok(ControlFlow::Continue(()))
    }

    /// Settings of the vehicle of an index, where it has none of its own; that of the first is the ego.
    fn settings(&self, scenario: &Scenario, index: usize) -> AgentSettings {
        let settings = AgentSettings {
            pose: self.config.pose_source.clone(),
            codec: self.config.codec,
            rate: self.config.rate,
            falsification: None,
        };
        settings.in_fleet(FleetPlace {
            scenario: &scenario.name,
            index,
            is_ego: index == 0,
            gate: self.ego.method().gate(),
        })
    }

    /// A vehicle with its pipeline.
    fn participant(
        &self,
        scenario: &Scenario,
        cav: &CavId,
        settings: &AgentSettings,
    ) -> Result<Participant, EvaluateError> {
        let detector =
            Detector::from_weights(&self.weights, &self.weights.detector_config()?, Device::Cpu)?;
        let place = scenario.agents.iter().position(|agent| agent == cav);
        let attack = match settings.falsification {
            Some(falsification) => Some(Attack::new(falsification, cav, 0)),
            None => { self.config.attack }.and_then(|attack| attack.of(place.unwrap_or(0), cav)),
        };
        let inference = Inference::new(Device::Cpu, self.config.precision);
        let agent = Agent::new(cav.clone(), settings.pose.build(inference)?, detector);
        let agent = agent.within(settings.rate);
        Ok(Participant::new(agent, attack, settings.codec))
    }

    /// True if sweeps have to be read at all.
    fn needs_points(&self) -> bool {
        let shares_points = self.ego.method().own_content() == Exchange::Points;
        self.maps.is_none() || shares_points || self.config.pose_source.looks_at_sweeps()
    }

    fn frame(
        &mut self,
        scenario: &Scenario,
        participants: &mut [Participant],
        sweeps: Vec<Sweep>,
        tick: usize,
    ) -> Result<EvaluatedFrame, EvaluateError> {
        let exchange = self.ego.method().own_content();
        let mut sent = Vec::with_capacity(sweeps.len());
        let mut frames = Vec::with_capacity(sweeps.len());
        for Sweep { place, frame, map } in sweeps {
            // Without an exchange, neighbours have nothing to encode; their poses are still needed.
            let is_needed = place == 0 || self.ego.method().exchange() != Exchange::Nothing;
            let participant = &mut participants[place];
            participant.capture(sent.last());
            let exchange = is_needed.then_some(exchange);
            let of_agent = view(participant, &frame, map.as_ref(), exchange)?;
            if let Some(reason) = &of_agent.failure {
                self.count_failure(scenario, tick, &of_agent.cav, reason);
            }
            sent.push(of_agent);
            frames.push(frame);
        }
        let poses = sent.iter().map(|sent| sent.pose).collect();
        let own = sent.remove(0);
        self.under_way.push_back(SentAtOnce {
            capture_nanos: own.capture_nanos,
            sent,
        });
        let arrived = self.arrived(own.capture_nanos).iter();
        let (neighbours, bytes): (Vec<View>, Vec<_>) = arrived.filter_map(Sent::received).unzip();
        let output = match own.view() {
            Some(view) => self.detect(scenario, tick, &view, &neighbours)?,
            // Every method needs the ego's own view, so it has failed.
            None => Err(own.failure.clone().unwrap_or_default()),
        };
        let (output, failure) = match output {
            Ok(output) => (output, None),
            Err(reason) => (EgoOutput::default(), Some(reason)),
        };
        let of_own = (&own.cav, own.pose, own.capture_nanos);
        Ok(EvaluatedFrame {
            tick,
            stamp: stamp(&own.cav, own.capture_nanos),
            result: self.report(tick, of_own, &neighbours, &bytes, output),
            failure,
            truth: GroundTruth::of_tick(&frames.iter().collect::<Vec<_>>(), 0, &self.rule),
            frames,
            poses,
        })
    }

    /// The ego's output, or the reason why this frame has none, which is counted.
    fn detect(
        &mut self,
        scenario: &Scenario,
        tick: usize,
        own: &View,
        neighbours: &[View],
    ) -> Result<Result<EgoOutput, String>, EvaluateError> {
        match self.ego.detect(own, neighbours) {
            Err(error) if error.is_of_frame() => {
                let reason = error.to_string();
                self.count_failure(scenario, tick, &own.cav, &reason);
                Ok(Err(reason))
            }
            output => Ok(Ok(output?)),
        }
    }

    /// The result that the ego would publish as its agent's frame of that number. `own` are its id, pose and capture
    /// time, `bytes` payload and wire bytes of each neighbour's message.
    fn report(
        &self,
        agent_frame: usize,
        (own, pose, capture_nanos): (&CavId, PoseEstimate, u64),
        neighbours: &[View],
        bytes: &[(u64, u64)],
        output: EgoOutput,
    ) -> Detections {
        let fused = (output.fused.iter())
            .map(|&index| FusedNeighbour {
                cav: neighbours[index].cav.clone(),
                age_nanos: capture_nanos as i64 - neighbours[index].capture_nanos as i64,
                confidence: neighbours[index].pose.confidence(),
                payload_bytes: bytes[index].0,
                wire_bytes: bytes[index].1,
            })
            .collect();
        let skipped = output
            .skipped
            .iter()
            .map(|&(index, reason)| SkippedNeighbour {
                cav: neighbours[index].cav.clone(),
                reason: match reason {
                    Skipped::Unusable(reason) => Some(reason),
                    Skipped::NotNeeded => None,
                },
            });
        Detections {
            ego: own.clone(),
            agent_frame: agent_frame as u64,
            method: self.ego.method().name().to_owned(),
            pose,
            detections: output.detections,
            fused,
            skipped: skipped.collect(),
            neighbours: neighbour_states(&output.beliefs, neighbours),
            stages: output.stages,
        }
    }

    /// The newest messages of the neighbours that have arrived; empty where all are still in flight.
    fn arrived(&mut self, now_nanos: u64) -> &[Sent] {
        let delay_nanos = self.config.delay_nanos;
        let has_arrived =
            |tick: &SentAtOnce| tick.capture_nanos.saturating_add(delay_nanos) <= now_nanos;
        while self.under_way.get(1).is_some_and(has_arrived) {
            self.under_way.pop_front();
        }
        self.under_way
            .front()
            .filter(|tick| has_arrived(tick))
            .map_or(&[], |tick| tick.sent.as_slice())
    }
}

/// The vehicles that lie completely over the area of a detector, as annotated by all agents within 70 m.
pub(crate) fn rule_for(config: &DetectorConfig) -> GroundTruthRule {
    let [x_low, y_low, z_low, x_high, y_high, z_high] = config.lidar_range_m;
    GroundTruthRule {
        x_m: [x_low, x_high],
        y_m: [y_low, y_high],
        z_m: [z_low, z_high],
        comm_range_m: Ego::COMM_RANGE_M,
        min_corners: 8,
        classes: ClassSet::VEHICLES,
    }
}
