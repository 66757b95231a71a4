//! A method on recorded scenes, frame by frame, through the same code and the same messages as in a live run.
//!
//! Every vehicle runs an [`Agent`]; what it would publish is encoded, weighed and decoded again; the [`Ego`] detects.
//! Nothing is lost, and nothing is late unless asked for, so a live run paced like that gives the same boxes. With
//! [`Evaluator::with_link`] messages cross the emulated air in virtual time ([`stepped`]).

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
use agent::rate::RateConfig;
use dataset::class_set::ClassSet;
use dataset::evaluation_protocol::EvaluationProtocol;
use dataset::frame::Frame;
use dataset::ground_truth::{self, GroundTruthRule};
use dataset::{LeftOut, LoadOptions, Scenario};
use localization::pose_source::{NoiseMode, PoseSourceConfig};
use perception::detector::Detector;
use perception::model_config::DetectorConfig;
use perception::weights::Weights;
use protocol::message::{Detections, FusedNeighbour, SkippedNeighbour};
use protocol::{Box3d, CavId, CodecConfig, Ledger, PoseEstimate, Stamp};

use ego_fuser::ego::{Ego, EgoOutput, Skipped, View};
use ego_fuser::misbehaviour::{MisbehaviourConfig, heard};
use fusion::method::{Exchange, Method};
use training::feature_store::MapSource;

pub use error::EvaluateError;
use participant::Participant;
use sent::{Sent, stamp, view};
use stepped::{RemotePool, SteppedConfig, VehicleConfig};
use sweeps::Sweep;

/// What to evaluate.
#[derive(Debug, Clone)]
pub struct EvaluateConfig {
    /// Weights of encoder and head.
    pub weights: PathBuf,
    /// The method; absent: the one the weights name.
    pub method: Option<Method>,
    /// Where the vehicles' poses come from.
    pub pose_source: PoseSourceConfig,
    /// How maps are encoded; without a gate the method's own holds.
    pub codec: CodecConfig,
    /// What neighbours fit theirs to. There is no queue to watch here.
    pub rate: RateConfig,
    /// Whose messages and annotations count, and which objects; absent: vehicles wholly over the area of the network,
    /// of all agents within 70 m.
    pub protocol: Option<EvaluationProtocol>,
    /// How long messages of neighbours are under way, nanoseconds: the ego fuses the newest that are at least so old.
    pub delay_nanos: u64,
    /// Neighbours that lie; absent: none.
    pub attack: Option<AttackConfig>,
    /// Whether the ego leaves out neighbours that it does not trust.
    pub trust: Option<MisbehaviourConfig>,
}

/// One frame of the ego with everything it can be judged by.
#[derive(Debug, Clone)]
pub struct EvaluatedFrame {
    /// Tick of the scenario.
    pub tick: usize,
    /// Who spoke for the result, and for which capture time.
    pub stamp: Stamp,
    /// What the ego would have published.
    pub result: Detections,
    /// The frames of all vehicles that take part, the ego first: true poses and annotations.
    pub frames: Vec<Frame>,
    /// Where each of them believes to be.
    pub poses: Vec<PoseEstimate>,
    /// The objects that count, in the ego's LiDAR frame.
    pub objects: Vec<Box3d>,
}

/// What all neighbours sent at one tick; nothing where none takes part.
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
    /// What the neighbours have sent, oldest first; the first is what has arrived last, or has not arrived yet.
    under_way: VecDeque<SentAtOnce>,
    maps: Option<MapSource>,
    /// How messages cross the air; absent: at once, or after a fixed delay.
    stepped: Option<SteppedConfig>,
    /// Who computes what the vehicles see; absent: this process.
    remote: Option<RemotePool>,
    ledger: Ledger,
    /// Data that could not be used.
    left_out: LeftOut,
    /// Bytes of all that neighbours handed to the air.
    sent_bytes: u64,
}

impl Evaluator {
    /// Reads the weights.
    ///
    /// # Errors
    /// [`EvaluateError`] names the file and what is wrong with it.
    pub fn new(config: EvaluateConfig) -> Result<Self, EvaluateError> {
        let ego = Ego::load(&config.weights, config.method)?.with_trust(config.trust)?;
        let area = ego.detector().config();
        let rule = config
            .protocol
            .as_ref()
            .map_or_else(|| rule_for(area), |protocol| protocol.rule_within(area.lidar_range_m));
        let ego = ego.with_comm_range(rule.comm_range_m);
        let codec = CodecConfig { gate: config.codec.gate.or(ego.method().gate()), ..config.codec };
        let config = EvaluateConfig { codec, ..config };
        let weights = Weights::load(&config.weights)?;
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

    /// The same with messages that cross the emulated air, in virtual time.
    #[must_use]
    pub fn with_link(self, stepped: SteppedConfig) -> Self {
        Self { stepped: Some(stepped), ..self }
    }

    /// Lets vehicles compute in processes of their own from now on, or in this one, where messages cross the emulated air.
    /// Those of before get no more sweeps.
    pub fn set_processes(&mut self, remote: Option<RemotePool>) {
        if let Some(before) = std::mem::replace(&mut self.remote, remote) {
            before.finish();
        }
    }

    /// The books of all messages that crossed the air so far; empty without one.
    #[must_use]
    pub fn ledger(&self) -> &Ledger {
        &self.ledger
    }

    /// Bytes of all that neighbours handed to the air so far, poses and headers included; 0 without one.
    #[must_use]
    pub fn sent_bytes(&self) -> u64 {
        self.sent_bytes
    }

    /// The same with maps that its encoder made before, kept as exactly as messages say them or more: those say the same
    /// then.
    #[must_use]
    pub fn with_maps(self, maps: MapSource) -> Self {
        Self { maps: Some(maps), ..self }
    }

    /// The ego's pipeline.
    #[must_use]
    pub fn ego(&self) -> &Ego {
        &self.ego
    }

    /// The protocol with the ground-truth rule as it is applied to this network; absent where none was asked for.
    #[must_use]
    pub fn protocol(&self) -> Option<EvaluationProtocol> {
        let protocol = self.config.protocol.clone()?;
        Some(EvaluationProtocol { ground_truth: self.rule, ..protocol })
    }

    /// Which objects count.
    #[must_use]
    pub fn rule(&self) -> &GroundTruthRule {
        &self.rule
    }

    /// RunScope over a scenario, its first agent being the ego; `on_frame` may end it. Frames that cannot be read are left out
    /// and counted ([`Self::left_out`]): a neighbour's as if it were absent, the ego's with its whole tick.
    ///
    /// # Errors
    /// [`EvaluateError`] when the pipeline refuses.
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
        let load = LoadOptions { points, ..LoadOptions::default() };
        let mut participants = Vec::with_capacity(scenario.agents.len());
        for cav in &scenario.agents {
            participants.push(self.participant(scenario, cav, participants.is_empty(), None)?);
        }
        let places: Vec<usize> = (0..participants.len()).collect();
        for tick in 0..scenario.ticks.len() {
            let sweeps = self.sweeps(scenario, tick, &places, &load, |_| true)?;
            if sweeps.first().is_none_or(|ego| ego.place != 0) {
                continue;
            }
            if on_frame(self.frame(&mut participants, sweeps, tick)?).is_break() {
                return Ok(ControlFlow::Break(()));
            }
        }
        Ok(ControlFlow::Continue(()))
    }

    /// A vehicle with its pipeline.
    fn participant(
        &self,
        scenario: &Scenario,
        cav: &CavId,
        is_ego: bool,
        own: Option<&VehicleConfig>,
    ) -> Result<Participant, EvaluateError> {
        let all = &self.config.pose_source;
        let source = match own {
            Some(own) => own.pose_source.clone(),
            None if is_ego => source_of_ego(all),
            None => all.clone(),
        };
        // What the ego's own vehicle tells it does not cross the air.
        let rate = if is_ego { RateConfig::default() } else { own.map_or(self.config.rate, |own| own.rate) };
        let detector = Detector::from_weights(&self.weights, &self.weights.config()?)?;
        let place = scenario.agents.iter().position(|agent| agent == cav).unwrap_or(0);
        let attack = match own.and_then(|own| own.lie) {
            Some(lie) => Some(Attack::new(lie, cav, 0)),
            None => self.config.attack.and_then(|attack| attack.of(place, cav)),
        };
        let agent = Agent::new(cav.clone(), source.for_scenario(&scenario.name).build()?, detector);
        Ok(Participant::new(agent.within(rate), attack))
    }

    /// Whether sweeps have to be read at all.
    fn needs_points(&self) -> bool {
        let shares_points = self.ego.method().own_content() == Exchange::Points;
        self.maps.is_none() || shares_points || self.config.pose_source.looks_at_sweeps()
    }

    fn frame(
        &mut self,
        participants: &mut [Participant],
        sweeps: Vec<Sweep>,
        tick: usize,
    ) -> Result<EvaluatedFrame, EvaluateError> {
        let exchange = self.ego.method().own_content();
        let mut sent = Vec::with_capacity(sweeps.len());
        let mut frames = Vec::with_capacity(sweeps.len());
        for Sweep { place, frame, map } in sweeps {
            // Without an exchange, neighbours have nothing to encode; where they are is still asked.
            let is_needed = place == 0 || self.ego.method().exchange() != Exchange::Nothing;
            let codec = if place == 0 { of_the_ego(self.config.codec) } else { self.config.codec };
            let participant = &mut participants[place];
            participant.overhear(sent.last());
            sent.push(view(participant, &frame, map.as_ref(), is_needed.then_some(exchange), &codec)?);
            frames.push(frame);
        }
        let poses = sent.iter().map(|sent| sent.pose).collect();
        let own = sent.remove(0);
        let own = own.view().expect("the ego is needed by every method");
        self.under_way.push_back(SentAtOnce { capture_nanos: own.capture_nanos, sent });
        let (neighbours, bytes): (Vec<View>, Vec<_>) =
            self.arrived(own.capture_nanos).iter().filter_map(Sent::heard).unzip();
        let output = self.ego.detect(&own, &neighbours)?;
        let result = self.report(tick, &own, &neighbours, &bytes, output);
        let objects = ground_truth::merge(&frames.iter().collect::<Vec<_>>(), 0, &self.rule);
        let objects = objects.into_iter().map(|(_, object)| object).collect();
        let stamp = stamp(&own.cav, frames[0].capture_nanos);
        Ok(EvaluatedFrame { tick, stamp, result, frames, poses, objects })
    }

    /// What the ego would publish as its agent's frame of that number; `bytes` are payload and wire bytes of each
    /// neighbour's message.
    fn report(
        &self,
        agent_frame: usize,
        own: &View,
        neighbours: &[View],
        bytes: &[(u64, u64)],
        output: EgoOutput,
    ) -> Detections {
        let fused = (output.fused.iter())
            .map(|&index| FusedNeighbour {
                cav: neighbours[index].cav.clone(),
                age_nanos: neighbours[index].age_nanos(own),
                confidence: neighbours[index].pose.confidence(),
                payload_bytes: bytes[index].0,
                wire_bytes: bytes[index].1,
            })
            .collect();
        let skipped = output.skipped.iter().map(|&(index, reason)| SkippedNeighbour {
            cav: neighbours[index].cav.clone(),
            reason: match reason {
                Skipped::Unusable(reason) => Some(reason),
                Skipped::NotNeeded => None,
            },
        });
        Detections {
            ego: own.cav.clone(),
            agent_frame: agent_frame as u64,
            method: self.ego.method().name().to_owned(),
            pose: own.pose,
            detections: output.detections,
            fused,
            skipped: skipped.collect(),
            heard: heard(&output.beliefs, neighbours),
            stages: output.stages,
        }
    }

    /// What the neighbours sent last of all that has arrived; nothing where all is still under way.
    fn arrived(&mut self, now_nanos: u64) -> &[Sent] {
        let delay_nanos = self.config.delay_nanos;
        let has_arrived = |tick: &SentAtOnce| tick.capture_nanos.saturating_add(delay_nanos) <= now_nanos;
        while self.under_way.get(1).is_some_and(has_arrived) {
            self.under_way.pop_front();
        }
        self.under_way.front().filter(|tick| has_arrived(tick)).map_or(&[], |tick| tick.sent.as_slice())
    }
}

/// The vehicles that lie wholly over the area of a detector, as annotated by all agents within 70 m.
#[must_use]
pub fn rule_for(config: &DetectorConfig) -> GroundTruthRule {
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

/// What the ego leaves out for others it has itself.
fn of_the_ego(codec: CodecConfig) -> CodecConfig {
    CodecConfig { gate: None, budget_bytes: None, ..codec }
}

/// Where the ego's own poses come from: one fixed offset spares it, as in the reference code. With the same offset on all
/// vehicles they would hardly be displaced among each other.
fn source_of_ego(all: &PoseSourceConfig) -> PoseSourceConfig {
    match all {
        PoseSourceConfig::Noisy(noisy) if noisy.mode == NoiseMode::Fixed => PoseSourceConfig::Recorded,
        other => other.clone(),
    }
}
