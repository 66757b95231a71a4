//! Agent loop: what a vehicle does with each input, at a time that is given. It has no network, clock or thread.
//!
//! A sweep waits for the pose and the motion of its capture time. Then it is computed in steps. The result of a step is
//! published before the next one: the pose, the perception, and the measurement for the poses of later sweeps.
//!
//! The live process, simulation time and the replay of recorded inputs are adapters: they bring inputs in order of time and
//! carry out the outputs. The same inputs give the same outputs, but for measured durations.

mod input;
mod message;
pub mod recorded;
mod sweep_reports;

use std::collections::BTreeMap;

use protocol::codec::CodecConfig;
use protocol::message::{Points, StageTiming};
use protocol::{CavId, DropReason, Dtype, Gnss, GnssSource, Message, Pace, PoseEstimate, Stream};
use tch::Tensor;

use crate::agent::{Agent, AgentInput, EncodedSweep};
use crate::agent_output::Perception;
use crate::attack::{Attack, CapturedMessages, Falsification};
use crate::rate::RateConfig;
use crate::sweep_pairing::{PairedSweep, SweepPairing};
use crate::sweep_selection::{MAX_EGOS, PaceSelection};
use sweep_reports::SweepReports;
pub use sweep_reports::descriptor;

pub use input::{LoopInput, LoopOutput, Sweep};
pub use message::{Content, MessageEncoder, Unsent};

/// Longest time that a sweep waits for its pose, which was sent before it, nanoseconds.
const POSE_TIMEOUT_NANOS: u64 = 200_000_000;
/// Time without a pose after which it is a problem, nanoseconds.
const NO_POSE_NANOS: u64 = 3_000_000_000;

/// Options of an agent's loop.
#[derive(Debug, Clone)]
pub struct LoopOptions {
    /// Streams beside the pose: any of [`Stream::Bev`], [`Stream::Boxes`] and [`Stream::Points`], for which the agent
    /// needs a detector.
    pub publish: Vec<Stream>,
    /// Codec of feature maps.
    pub codec: CodecConfig,
    /// Rate control of feature maps.
    pub rate: RateConfig,
    /// Egos whose pace is followed; none: any ego's is.
    pub egos: Vec<CavId>,
    /// Falsification of what is published.
    pub falsification: Option<Falsification>,
}

impl Default for LoopOptions {
    /// Feature maps as `f32`, dense.
    fn default() -> Self {
        Self {
            publish: vec![Stream::Bev],
            codec: CodecConfig {
                dtype: Dtype::F32,
                ..CodecConfig::default()
            },
            rate: RateConfig::default(),
            egos: Vec::new(),
            falsification: None,
        }
    }
}

impl LoopOptions {
    /// True if the detector's network is computed: points are published as they are, and poses need none.
    fn needs_network(&self) -> bool {
        self.publish.iter().any(|stream| *stream != Stream::Points)
    }

    /// True if detections are published, or confidence chooses the cells of maps.
    fn needs_head(&self) -> bool {
        self.publish.contains(&Stream::Boxes)
            || self.codec.budget_bytes.is_some()
            || self.codec.gate.is_some()
            || self.rate != RateConfig::default()
    }
}

/// Summary of an agent's run.
#[derive(Debug, Clone, PartialEq, Eq, Default, serde::Serialize)]
pub struct LoopReport {
    /// Sweeps computed.
    pub sweeps: u64,
    /// Of these, without a pose.
    pub no_pose: u64,
    /// Sweeps that could not be computed.
    pub failed: u64,
    /// Reason of the first of these.
    pub failure: Option<String>,
    /// Poses that the vehicle cannot have reached from the previous ones; they are published with little confidence.
    pub pose_jumps: u64,
    /// Paces that are not followed: their egos are not of the run, or there are too many.
    pub unfollowed_paces: u64,
}

/// Next step of the loop.
#[derive(Default)]
enum LoopStep {
    /// The pose of the next sweep, when it has waited.
    #[default]
    Localize,
    /// The perception of a sweep whose pose is published.
    Perceive(PairedSweep<Sweep>, PoseEstimate, EncodedSweep),
    /// The measurement for the poses of later sweeps.
    Observe(PairedSweep<Sweep>, EncodedSweep),
}

impl PairedSweep<Sweep> {
    fn input(&self) -> AgentInput<'_> {
        AgentInput {
            capture_nanos: self.capture_nanos,
            cloud: &self.sweep.cloud,
            measured_pose: self.pose.as_ref(),
            motion: self.motion.unwrap_or_default(),
        }
    }
}

/// The state of an agent between two inputs.
pub struct AgentLoop {
    agent: Agent,
    options: LoopOptions,
    pairing: SweepPairing<Sweep>,
    selection: PaceSelection,
    reports: SweepReports,
    step: LoopStep,
    /// Messages of each stream so far.
    numbers: BTreeMap<Stream, u64>,
    /// Time of the last pose, or of the first sweep, nanoseconds.
    last_pose_nanos: Option<u64>,
    has_ended: bool,
    report: LoopReport,
    outputs: Vec<LoopOutput>,
}

impl AgentLoop {
    /// Loop of a vehicle before its first input.
    pub fn new(mut agent: Agent, options: LoopOptions) -> Self {
        if let Some(falsification) = options.falsification {
            let attack = Attack::new(falsification, agent.cav(), 0);
            agent = agent.with_attack(Some(attack));
        }
        agent.has_head = options.needs_head() || agent.attack.is_some();
        Self {
            pairing: SweepPairing::new(POSE_TIMEOUT_NANOS),
            selection: PaceSelection::of(&options.egos),
            reports: SweepReports::new(agent.detector(), &options),
            agent,
            options,
            step: LoopStep::default(),
            numbers: BTreeMap::new(),
            last_pose_nanos: None,
            has_ended: false,
            report: LoopReport::default(),
            outputs: Vec::new(),
        }
    }

    /// Computes without a sweep, so that the first one does not wait for the tensor library's preparations.
    pub fn warm_up(&mut self) {
        if self.options.needs_network()
            && let Err(error) = self.agent.warm_up()
        {
            tracing::warn!("the detector is not warmed up: {error}");
        }
    }

    /// Sets the feature map `[1, C, H, W]` of the next sweep, if its encoder computed it before.
    pub fn set_known_map(&mut self, map: Option<Tensor>) {
        self.agent.known_map = map;
    }

    /// Passes on the last messages of another vehicle, which an attack may replay.
    pub fn capture(&mut self, captured: impl FnOnce() -> CapturedMessages) {
        if let Some(attack) = &mut self.agent.attack {
            attack.capture(captured());
        }
    }

    /// Takes an input in at `now_nanos`, which does not decrease. Only [`LoopInput::Wake`] computes, and one step at most:
    /// the result of a step is published before the next one.
    pub fn handle(&mut self, input: LoopInput, now_nanos: u64) -> Vec<LoopOutput> {
        match input {
            LoopInput::Sweep(sweep) => self.admit(sweep, now_nanos),
            LoopInput::Gnss(capture_nanos, gnss) if gnss.source == GnssSource::Stated => {
                // A stated pose belongs to no sweep, so it is not paired.
                self.start_at(capture_nanos, &gnss);
            }
            LoopInput::Gnss(capture_nanos, gnss) => {
                let poses = self.pairing.poses.add(capture_nanos, gnss.world_from_lidar);
                self.drop_messages(Stream::Gnss, poses, DropReason::Superseded);
            }
            LoopInput::Motion(capture_nanos, motion) => {
                let motions = self.pairing.motions.add(capture_nanos, motion);
                self.drop_messages(Stream::Imu, motions, DropReason::Superseded);
            }
            LoopInput::Pace(ego, pace) => self.follow(&ego, pace, now_nanos),
            LoopInput::PaceEnded(ego) => self.selection.forget(&ego),
            LoopInput::Ended => self.has_ended = true,
            LoopInput::SceneEnded => self.reports.has_ended = true,
            LoopInput::Wake => self.wake(now_nanos),
        }
        std::mem::take(&mut self.outputs)
    }

    /// Time by which the loop has to be woken, 0 if at once, nanoseconds.
    pub fn wakes_nanos(&self) -> u64 {
        // The next step, or what is left of the run, needs no message.
        if self.is_computing() || self.has_ended {
            return 0;
        }
        let deadline = self.pairing.deadline_nanos().unwrap_or(u64::MAX);
        deadline.min(self.reports.next_nanos)
    }

    /// True between two steps of a sweep.
    pub fn is_computing(&self) -> bool {
        !matches!(self.step, LoopStep::Localize)
    }

    /// True after the end, when every sweep is computed.
    pub fn is_finished(&self) -> bool {
        self.has_ended && !self.is_computing() && self.pairing.deadline_nanos().is_none()
    }

    /// The vehicle's pipeline.
    pub fn agent(&self) -> &Agent {
        &self.agent
    }

    /// Summary so far.
    pub fn report(&self) -> &LoopReport {
        &self.report
    }

    /// A sweep that an ego has time for waits for its pose; others are left out.
    fn admit(&mut self, sweep: Sweep, now_nanos: u64) {
        let capture_nanos = sweep.capture_nanos;
        // Sweeps that are left out are reported, too: their arrivals serve the capture clocks of egos.
        self.reports.note(capture_nanos, sweep.arrived_nanos);
        self.describe(now_nanos);
        if !self.selection.admits(capture_nanos, now_nanos) {
            self.drop_messages(Stream::Lidar, 1, DropReason::Paced);
        } else if { self.pairing.add_sweep(capture_nanos, sweep, now_nanos) }.is_some() {
            self.drop_messages(Stream::Lidar, 1, DropReason::Superseded);
        }
    }

    /// Starts the pose source anew at a stated pose.
    fn start_at(&mut self, capture_nanos: u64, stated: &Gnss) {
        self.outputs.push(LoopOutput::Received(Stream::Gnss));
        let [x, y, _] = stated.world_from_lidar.translation_m;
        if self.agent.start_at(capture_nanos, stated) {
            tracing::info!("starts at the stated pose x {x:.2} y {y:.2} m");
        } else {
            tracing::warn!(
                "the pose source takes no stated pose (tracked does): x {x:.2} y {y:.2} m is ignored"
            );
        }
    }

    /// Follows the pace of an ego of the run; others are counted, and the first is logged.
    fn follow(&mut self, ego: &CavId, pace: Pace, now_nanos: u64) {
        if !self.selection.follow(ego, pace, now_nanos) {
            if self.report.unfollowed_paces == 0 {
                tracing::warn!(%ego, "the pace of this ego is ignored: the run has other egos, or {MAX_EGOS} already");
            }
            self.report.unfollowed_paces += 1;
        }
    }

    fn drop_messages(&mut self, stream: Stream, count: usize, reason: DropReason) {
        let dropped = (0..count).map(|_| LoopOutput::Dropped(stream, reason));
        self.outputs.extend(dropped);
    }

    fn publish(&mut self, stream: Stream, capture_nanos: u64, content: Content) {
        let next = self.numbers.entry(stream).or_default();
        let message = Unsent {
            stream,
            number: *next,
            capture_nanos,
            content,
        };
        *next += 1;
        self.outputs.push(LoopOutput::Publish(Box::new(message)));
    }

    /// Publishes the descriptor if it is due.
    fn describe(&mut self, now_nanos: u64) {
        if let Some((newest_nanos, descriptor)) = self.reports.take_due(now_nanos) {
            let content = Content::Fixed(Message::Descriptor(descriptor));
            self.publish(Stream::Descriptor, newest_nanos, content);
        }
    }

    fn wake(&mut self, now_nanos: u64) {
        self.describe(now_nanos);
        // The default is the next sweep: after a step that failed there is none to continue.
        match std::mem::take(&mut self.step) {
            LoopStep::Localize => {
                // Nothing comes any more that a sweep may wait for.
                let waited_nanos = if self.has_ended { u64::MAX } else { now_nanos };
                if let Some(paired) = self.pairing.next(waited_nanos) {
                    self.localize(paired, now_nanos);
                }
            }
            LoopStep::Perceive(paired, pose, sweep) => self.perceive(paired, pose, sweep),
            LoopStep::Observe(paired, sweep) => {
                let times = self.agent.observe_encoded(&paired.input(), &sweep);
                self.outputs.push(LoopOutput::Timed(times));
            }
        }
    }

    /// First step of a sweep: its pose.
    fn localize(&mut self, paired: PairedSweep<Sweep>, now_nanos: u64) {
        // Measurements whose sweeps were superseded, and they with them.
        self.drop_messages(Stream::Gnss, paired.unused_poses, DropReason::Superseded);
        self.drop_messages(Stream::Imu, paired.unused_motions, DropReason::Superseded);
        let used = [
            paired.pose.map(|_| Stream::Gnss),
            paired.motion.map(|_| Stream::Imu),
        ];
        // Counted here and not on arrival: until now they could be superseded with their sweep.
        let received = used.into_iter().flatten().map(LoopOutput::Received);
        self.outputs.extend(received);
        let (pose, times, sweep) = self.agent.localize(&paired.input());
        let content = Content::Fixed(Message::Pose(pose));
        self.publish(Stream::Pose, paired.capture_nanos, content);
        self.outputs.push(LoopOutput::Timed(times));
        self.note_pose(&pose, now_nanos);
        self.report.pose_jumps = self.agent.pose_source.jumps();
        self.step = LoopStep::Perceive(paired, pose, sweep);
    }

    /// Counts a missing pose; no pose for three seconds is a problem.
    fn note_pose(&mut self, pose: &PoseEstimate, now_nanos: u64) {
        // The first sweep starts the count: before it nothing was missing.
        let last_nanos = *self.last_pose_nanos.get_or_insert(now_nanos);
        let problem = match pose {
            PoseEstimate::Pose { .. } => {
                self.last_pose_nanos = Some(now_nanos);
                None
            }
            PoseEstimate::NoPose { reason, .. } => {
                self.report.no_pose += 1;
                let reason = <&str>::from(reason).replace('_', " ");
                (now_nanos.saturating_sub(last_nanos) > NO_POSE_NANOS)
                    .then(|| (format!("no pose: {reason}"), last_nanos))
            }
        };
        self.outputs.push(LoopOutput::PoseProblem(problem));
    }

    /// Second step: the perception.
    fn perceive(
        &mut self,
        paired: PairedSweep<Sweep>,
        pose: PoseEstimate,
        mut sweep: EncodedSweep,
    ) {
        let capture_nanos = paired.capture_nanos;
        let (cloud, arrived_nanos) = (&paired.sweep.cloud, paired.sweep.arrived_nanos);
        // Without a network the sweep itself is all there is to send.
        let perceived = match self.options.needs_network() {
            true => self.agent.perceive_encoded(cloud, &mut sweep).map(Some),
            false => Ok(None),
        };
        match perceived {
            Ok(perception) => {
                self.report.sweeps += 1;
                let mut times = vec![StageTiming::new("agent", sweep.began.elapsed())];
                if let Some(perception) = perception {
                    times.extend_from_slice(&perception.times);
                    self.publish_perception(capture_nanos, pose, perception);
                }
                self.outputs.push(LoopOutput::Timed(times));
                if self.options.publish.contains(&Stream::Points) {
                    let points = self.agent.share_points(cloud);
                    let content = Content::Fixed(Message::Points(Points { pose, points }));
                    self.publish(Stream::Points, capture_nanos, content);
                }
                self.outputs.push(LoopOutput::Received(Stream::Lidar));
                self.step = LoopStep::Observe(paired, sweep);
            }
            Err(error) => {
                self.report.failed += 1;
                self.report.failure.get_or_insert_with(|| error.to_string());
                let reason = match error.is_of_frame() {
                    true => DropReason::NotFinite,
                    false => DropReason::Shape,
                };
                self.drop_messages(Stream::Lidar, 1, reason);
                self.outputs.push(LoopOutput::Failed(error));
            }
        }
        self.outputs.push(LoopOutput::Computed {
            capture_nanos,
            arrived_nanos,
        });
    }

    fn publish_perception(
        &mut self,
        capture_nanos: u64,
        pose: PoseEstimate,
        perception: Perception,
    ) {
        // Boxes first: they are what an ego falls back on while a large map is on its way.
        if self.options.publish.contains(&Stream::Boxes) {
            let boxes = self.agent.boxes(capture_nanos, pose, perception.detections);
            let content = Content::Fixed(Message::Boxes(boxes));
            self.publish(Stream::Boxes, capture_nanos, content);
        }
        if self.options.publish.contains(&Stream::Bev) {
            let content = Content::Map {
                pose,
                features: perception.features,
                confidence: perception.confidence,
            };
            self.publish(Stream::Bev, capture_nanos, content);
        }
    }
}

#[cfg(test)]
mod tests;
