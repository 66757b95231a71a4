//! Offline evaluation: a method on recorded scenes, frame by frame, with the code and messages of a live run.
//!
//! Every vehicle runs an [`Agent`]; its messages are encoded, measured and decoded again; the ego's loop decides and
//! the [`Ego`] detects. Without a link emulation nothing is lost, and nothing is late unless configured, so a live run
//! at that pace gives the same boxes.

pub mod alignment;
mod error;
mod participant;
mod sent;
mod setup;
pub mod stepped;
mod sweeps;

use std::ops::ControlFlow;

use agent::agent::Agent;
use agent::agent_loop::descriptor;
use agent::config::{AgentSettings, FleetPlace};
use dataset::evaluation_protocol::EvaluationProtocol;
use dataset::frame::Frame;
use dataset::ground_truth::{GroundTruth, GroundTruthRule};
use dataset::{LeftOut, Scenario};
use perception::detector::Detector;
use perception::inference::Inference;
use perception::model_config::DetectorConfig;
use perception::weights::Weights;
use protocol::message::{Descriptor, Detections};
use protocol::{Ledger, Pose, PoseEstimate, Stamp, Stream, Tracks};
use tch::Device;

use ego_fuser::ego::Ego;
use fusion::method::Exchange;
use training::feature_store::MapSource;

pub use error::EvaluateError;
use participant::Participant;
pub use setup::{AgentPool, EmulatedLink, Setup};
use stepped::RemotePool;
pub use sweeps::{add_unplaced_tick, without_true_pose};

/// One frame of the ego with all data for its evaluation.
#[derive(Debug, Clone)]
pub struct EvaluatedFrame {
    /// Tick of the scenario.
    pub tick: usize,
    /// Sender and capture time of the result.
    pub stamp: Stamp,
    /// Detections that the ego would have published; without boxes if it has failed.
    pub result: Detections,
    /// Tracks after them, if the ego tracks and has not failed.
    pub tracks: Option<Tracks>,
    /// Reason why the ego has no result; counted in [`Evaluator::left_out`].
    pub failure: Option<String>,
    /// The frames of all vehicles that take part, the ego first: true poses and annotations.
    pub frames: Vec<Frame>,
    /// Reported pose of each of them.
    pub poses: Vec<PoseEstimate>,
    /// Objects in the ego's LiDAR frame, and the range of those that count.
    pub truth: GroundTruth,
}

impl EvaluatedFrame {
    /// The ego's true pose, if the recording has it. Without it nothing tells where the true boxes are: the frame counts
    /// in no score, and [`Evaluator::left_out`] names it.
    pub fn true_pose(&self) -> Option<Pose> {
        self.frames.first()?.world_from_lidar
    }
}

/// Evaluates scenarios one after another.
#[derive(Debug)]
pub struct Evaluator {
    /// Its settings; of those only the compute times may change, where they are measured.
    pub setup: Setup,
    weights: Weights,
    /// The ego's pipeline.
    pub ego: Ego,
    /// Rule for the objects that count.
    pub rule: GroundTruthRule,
    maps: Option<MapSource>,
    /// Processes that run the vehicles' pipelines; absent: this process.
    remote: Option<RemotePool>,
    /// The accounting of all messages on the link so far; empty without a link emulation.
    pub ledger: Ledger,
    /// Data that could not be used so far.
    pub left_out: LeftOut,
    /// Bytes of all messages that neighbours handed to the link so far, poses and headers included; 0 without a link
    /// emulation.
    pub sent_bytes: u64,
}

impl Evaluator {
    /// Reads the weights.
    ///
    /// # Errors
    /// [`EvaluateError`] names the file and what is wrong with it.
    pub fn new(setup: Setup) -> Result<Self, EvaluateError> {
        let weights = Weights::load(&setup.models.weights)?.with_precision(setup.models.precision);
        let ego = Ego::from_weights(&weights, setup.method, Device::Cpu)?;
        let ego = ego
            .with_box_alignment(setup.ego.box_alignment)
            .with_misbehaviour_detection(setup.ego.trust)?;
        let area = ego.detector().config();
        let rule = setup.protocol.as_ref().map_or_else(
            || rule_for(area),
            |protocol| protocol.rule_within(area.lidar_range_m),
        );
        Ok(Self {
            ego: ego.with_comm_range(rule.comm_range_m),
            weights,
            rule,
            setup,
            maps: None,
            remote: None,
            ledger: Ledger::default(),
            left_out: LeftOut::default(),
            sent_bytes: 0,
        })
    }

    /// Runs the vehicles' pipelines in processes of their own from now on, or in this one. The previous processes get
    /// no more sweeps.
    pub fn set_processes(&mut self, remote: Option<RemotePool>) {
        if let Some(before) = std::mem::replace(&mut self.remote, remote) {
            before.finish();
        }
    }

    /// The same with maps that its encoder computed before. Maps that are stored at least as exactly as in messages give
    /// the same messages; boxes of single vehicles (`none`, `late`) are the same only if they are kept in 32 bits.
    pub fn with_maps(mut self, maps: MapSource) -> Self {
        self.maps = Some(maps);
        self
    }

    /// The protocol with the ground-truth rule that applies to this network; absent where none was configured.
    pub fn protocol(&self) -> Option<EvaluationProtocol> {
        let protocol = self.setup.protocol.as_ref()?;
        Some(protocol.within(self.ego.detector().config().lidar_range_m))
    }

    /// Runs over a scenario; `on_frame` may end it. Frames that cannot be read are left out and counted
    /// ([`Self::left_out`]): a neighbour's as if it were absent, the ego's with its whole tick. So are ticks without the
    /// ego's true pose, though it drives on, and frames that cannot be computed, but a tick of the ego has no result
    /// then ([`EvaluatedFrame::failure`]).
    ///
    /// # Errors
    /// [`EvaluateError`] when the pipeline reports an error.
    pub fn run(
        &mut self,
        scenario: &Scenario,
        on_frame: &mut dyn FnMut(EvaluatedFrame) -> ControlFlow<()>,
    ) -> Result<ControlFlow<()>, EvaluateError> {
        // Maps and trust of the scene before mean nothing in this one.
        self.ego.forget();
        stepped::run(self, scenario, on_frame)
    }

    /// The vehicle at `place` among the agents of a scenario, with its pipeline: the `index`-th of those that take part.
    /// `needed` is the stream that the method needs of it.
    fn participant(
        &self,
        settings: &AgentSettings,
        scenario: &Scenario,
        (place, index): (usize, usize),
        (is_ego, needed): (bool, Option<Stream>),
    ) -> Result<Participant, EvaluateError> {
        let settings = settings.clone().in_fleet(FleetPlace {
            scenario: &scenario.name,
            index,
            is_ego,
            gate: self.ego.method().gate(),
        });
        let detector = self.detector_of(&settings)?;
        let publish = needed.map_or_else(Vec::new, |stream| settings.sent_for(stream));
        settings.check_limits(&publish, &detector)?;
        let cav = &scenario.agents[place];
        // A vehicle's own falsification takes precedence over the attack of the run.
        let attack = self.setup.attack.and_then(|attack| attack.of(place, cav));
        let inference = Inference::new(Device::Cpu, self.setup.models.precision);
        let agent = Agent::new(cav.clone(), settings.pose.build(inference)?, detector);
        let (agent, options) = (agent.with_attack(attack), settings.loop_options(publish));
        Ok(Participant::new(agent, options, settings.weights.is_some()))
    }

    /// The detector of a vehicle: its own network, or that of the run.
    fn detector_of(&self, settings: &AgentSettings) -> Result<Detector, EvaluateError> {
        let own = settings.weights.as_deref().map(Weights::load).transpose()?;
        let own = own.map(|weights| weights.with_precision(self.setup.models.precision));
        let weights = own.as_ref().unwrap_or(&self.weights);
        let config = weights.detector_config()?;
        Ok(Detector::from_weights(weights, &config, Device::Cpu)?)
    }

    /// The descriptor of a neighbour with these settings, where the method needs a `stream`.
    fn descriptor_of(
        &self,
        settings: &AgentSettings,
        stream: Stream,
    ) -> Result<Descriptor, EvaluateError> {
        let (dtype, publish) = (settings.codec.dtype, settings.sent_for(stream));
        Ok(match settings.weights {
            None => descriptor(self.ego.detector(), dtype, &publish),
            Some(_) => descriptor(&self.detector_of(settings)?, dtype, &publish),
        })
    }

    /// True if sweeps have to be read at all.
    fn needs_points(&self) -> bool {
        let shares_points = self.ego.method().own_content() == Exchange::Points;
        let own = std::iter::once(&self.setup.agents);
        let mut settings = own.chain(self.setup.vehicles.values());
        self.remote.is_some()
            || self.maps.is_none()
            || shares_points
            || settings
                .any(|settings| settings.weights.is_some() || settings.pose.looks_at_sweeps())
    }
}

/// The rule of OPV2V over the area of a detector: the vehicles that lie completely over it, as annotated by all agents
/// within 70 m.
fn rule_for(config: &DetectorConfig) -> GroundTruthRule {
    let [x_low, y_low, z_low, x_high, y_high, z_high] = config.lidar_range_m;
    GroundTruthRule {
        x_m: [x_low, x_high],
        y_m: [y_low, y_high],
        z_m: [z_low, z_high],
        ..GroundTruthRule::OPV2V
    }
}
