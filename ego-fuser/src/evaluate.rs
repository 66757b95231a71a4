//! A method on recorded scenes, frame by frame, through the same code and the same messages as in a live run.
//!
//! Every vehicle runs an [`Agent`]; what it would publish is encoded, weighed and decoded again; the [`Ego`] detects.
//! Nothing is late and nothing is lost, so a live run paced like that gives the same boxes.

use std::ops::ControlFlow;
use std::path::PathBuf;

use agent::agent::{Agent, AgentInput, Perception};
use agent::detector::{Detector, DetectorError};
use agent::pose_source::{PoseSourceConfig, PoseSourceError};
use agent::weights::{Weights, WeightsError};
use protocol::codec::encode_features;
use protocol::message::{Bev, Boxes, Detections, FusedNeighbour, Payload, Points, SkippedNeighbour};
use protocol::{Box3d, CavId, CodecConfig, HEADER_LEN, Header, Limits, PoseEstimate, Stamp, WireError, wire};
use sim_replay::dataset::{LoadOptions, ReadError, Scenario};
use sim_replay::frame::Frame;
use sim_replay::ground_truth::{self, GroundTruthRule};

use crate::ego::{Content, Ego, EgoError, Skipped, View, own_content};
use crate::method::{Exchange, Method};

/// What to evaluate.
#[derive(Debug, Clone)]
pub struct EvaluateConfig {
    /// Weights of encoder and head.
    pub weights: PathBuf,
    /// The method; absent: the one the weights name.
    pub method: Option<Method>,
    /// Where the vehicles' poses come from.
    pub pose_source: PoseSourceConfig,
    /// How maps are encoded.
    pub codec: CodecConfig,
    /// Which objects count; absent: those wholly over the area of the network, of all vehicles within 70 m.
    pub rule: Option<GroundTruthRule>,
}

/// Why an evaluation ended early.
#[derive(Debug, thiserror::Error)]
pub enum EvaluateError {
    /// The weights are not readable.
    #[error(transparent)]
    Weights(#[from] WeightsError),
    /// The detector refused.
    #[error(transparent)]
    Detector(#[from] DetectorError),
    /// The ego refused.
    #[error(transparent)]
    Ego(#[from] EgoError),
    /// A pose source cannot be set up.
    #[error(transparent)]
    PoseSource(#[from] PoseSourceError),
    /// A frame cannot be read.
    #[error(transparent)]
    Read(#[from] ReadError),
    /// A message cannot be encoded or decoded.
    #[error(transparent)]
    Wire(#[from] WireError),
}

/// One frame of the ego with everything it can be judged by.
#[derive(Debug, Clone)]
pub struct EvaluatedFrame {
    /// Who spoke for the result, and for which capture time.
    pub stamp: Stamp,
    /// What the ego would have published.
    pub result: Detections,
    /// The frames of all vehicles, the ego first: true poses and annotations.
    pub frames: Vec<Frame>,
    /// Where each of them believes to be.
    pub poses: Vec<PoseEstimate>,
    /// The objects that count, in the ego's LiDAR frame.
    pub objects: Vec<Box3d>,
}

/// Evaluates scenarios one after another.
#[derive(Debug)]
pub struct Evaluator {
    config: EvaluateConfig,
    weights: Weights,
    ego: Ego,
    rule: GroundTruthRule,
}

impl Evaluator {
    /// Reads the weights.
    ///
    /// # Errors
    /// [`EvaluateError`] names the file and what is wrong with it.
    pub fn new(config: EvaluateConfig) -> Result<Self, EvaluateError> {
        let ego = Ego::load(&config.weights, config.method)?;
        let rule = config.rule.unwrap_or_else(|| rule_of(ego.detector()));
        Ok(Self { weights: Weights::load(&config.weights)?, ego, rule, config })
    }

    /// The ego's pipeline.
    #[must_use]
    pub fn ego(&self) -> &Ego {
        &self.ego
    }

    /// Which objects count.
    #[must_use]
    pub fn rule(&self) -> &GroundTruthRule {
        &self.rule
    }

    /// Runs over a scenario, its first agent being the ego; `on_frame` may end it.
    ///
    /// # Errors
    /// [`EvaluateError`] at the first frame that cannot be read.
    pub fn run(
        &mut self,
        scenario: &Scenario,
        on_frame: &mut dyn FnMut(EvaluatedFrame) -> ControlFlow<()>,
    ) -> Result<ControlFlow<()>, EvaluateError> {
        let detector_config = self.weights.config()?;
        let mut agents = Vec::with_capacity(scenario.agents.len());
        for cav in &scenario.agents {
            let detector = Detector::from_weights(&self.weights, &detector_config)?;
            agents.push(Agent::new(cav.clone(), self.config.pose_source.build()?, detector));
        }
        for tick in 0..scenario.ticks.len() {
            let frames: Result<Vec<Frame>, _> =
                (0..agents.len()).map(|agent| scenario.load(agent, tick, &LoadOptions::default())).collect();
            let frame = self.frame(&mut agents, frames?, tick)?;
            if on_frame(frame).is_break() {
                return Ok(ControlFlow::Break(()));
            }
        }
        Ok(ControlFlow::Continue(()))
    }

    fn frame(
        &mut self,
        agents: &mut [Agent],
        frames: Vec<Frame>,
        tick: usize,
    ) -> Result<EvaluatedFrame, EvaluateError> {
        let exchange = own_content(self.ego.method());
        let mut sent = Vec::with_capacity(frames.len());
        for (index, (agent, frame)) in agents.iter_mut().zip(&frames).enumerate() {
            // Without an exchange, neighbours have nothing to encode; where they are is still asked.
            let is_needed = index == 0 || self.ego.method() != Method::None;
            sent.push(view(agent, frame, is_needed.then_some(exchange), &self.config.codec)?);
        }
        let poses = sent.iter().map(|sent| sent.pose).collect();
        let own_age = |frame: &Frame| frames[0].capture_nanos as i64 - frame.capture_nanos as i64;
        let mut views = Vec::with_capacity(sent.len());
        let mut bytes = Vec::with_capacity(sent.len());
        for (sent, frame) in sent.into_iter().zip(&frames) {
            let Some(content) = sent.content else { continue };
            bytes.push((sent.payload_bytes, sent.wire_bytes));
            views.push(View { cav: frame.cav.clone(), pose: sent.pose, age_nanos: own_age(frame), content });
        }
        let (own, neighbours) = views.split_first().expect("the ego is needed by every method");
        let output = self.ego.detect(own, neighbours)?;
        let fused = (output.fused.iter())
            .map(|&index| FusedNeighbour {
                cav: neighbours[index].cav.clone(),
                age_nanos: neighbours[index].age_nanos,
                confidence: neighbours[index].pose.confidence(),
                payload_bytes: bytes[index + 1].0,
                wire_bytes: bytes[index + 1].1,
            })
            .collect();
        let skipped = output.skipped.iter().map(|&(index, reason)| SkippedNeighbour {
            cav: neighbours[index].cav.clone(),
            reason: match reason {
                Skipped::Unusable(reason) => Some(reason),
                Skipped::NotNeeded => None,
            },
        });
        let result = Detections {
            ego: own.cav.clone(),
            frame_index: tick as u64,
            method: self.ego.method().name().to_owned(),
            pose: own.pose,
            detections: output.detections,
            fused,
            skipped: skipped.collect(),
            stages: output.stages,
        };
        let objects = ground_truth::merge(&frames.iter().collect::<Vec<_>>(), 0, &self.rule);
        let objects = objects.into_iter().map(|(_, object)| object).collect();
        let stamp = stamp(&own.cav, frames[0].capture_nanos);
        Ok(EvaluatedFrame { stamp, result, frames, poses, objects })
    }
}

/// The objects of all vehicles within 70 m that lie wholly over the area of a detector.
#[must_use]
pub fn rule_of(detector: &Detector) -> GroundTruthRule {
    let [x_low, y_low, z_low, x_high, y_high, z_high] = detector.config().lidar_range_m;
    GroundTruthRule {
        x_m: [x_low, x_high],
        y_m: [y_low, y_high],
        z_m: [z_low, z_high],
        comm_range_m: Ego::COMM_RANGE_M,
        min_corners: 8,
    }
}

/// What a vehicle sends for one frame.
struct Sent {
    pose: PoseEstimate,
    content: Option<Content>,
    payload_bytes: u64,
    wire_bytes: u64,
}

fn view(
    agent: &mut Agent,
    frame: &Frame,
    exchange: Option<Exchange>,
    codec: &CodecConfig,
) -> Result<Sent, EvaluateError> {
    let input = AgentInput {
        capture_nanos: frame.capture_nanos,
        cloud: &frame.points,
        measured_pose: frame.world_from_lidar.as_ref(),
    };
    let pose = agent.estimate_pose(&input);
    let stamp = stamp(agent.cav(), frame.capture_nanos);
    let (_, pose_bytes) = through_the_wire(&stamp, pose)?;
    let (content, bytes) = match exchange {
        None => return Ok(Sent { pose, content: None, payload_bytes: 0, wire_bytes: 0 }),
        Some(Exchange::Points) => {
            let points = agent.detector().crop().without_own_body(&frame.points);
            let (message, bytes) = through_the_wire(&stamp, Points { pose, points })?;
            (Content::Points(message.points), bytes)
        }
        Some(Exchange::Boxes) => {
            let detections = agent.perceive(&frame.points)?.detections;
            let (message, bytes) = through_the_wire(&stamp, Boxes { pose, detections })?;
            (Content::Boxes(message.detections), bytes)
        }
        Some(Exchange::Features | Exchange::Nothing) => {
            let Perception { features, confidence, .. } = agent.perceive(&frame.points)?;
            let features = encode_features(features, codec, Some(&confidence))?;
            let (message, bytes) = through_the_wire(&stamp, Bev { pose, features })?;
            (Content::Features(message.features.decode(&Limits::default())?), bytes)
        }
    };
    let payload_bytes = bytes - HEADER_LEN as u64;
    Ok(Sent { pose, content: Some(content), payload_bytes, wire_bytes: bytes + pose_bytes })
}

/// Encodes and decodes a message; its size on the wire.
fn through_the_wire<M: Payload>(stamp: &Stamp, message: M) -> Result<(M, u64), WireError> {
    let encoded = wire::encode(stamp, message)?;
    let bytes = encoded.pieces().iter().map(|piece| piece.len() as u64).sum();
    let (_, message): (Header, M) = wire::decode(encoded.pieces(), &Limits::default())?;
    Ok((message, bytes))
}

fn stamp(cav: &CavId, capture_nanos: u64) -> Stamp {
    Stamp { cav: cav.clone(), epoch: 0, sequence: 0, capture_nanos, publish_nanos: capture_nanos }
}
