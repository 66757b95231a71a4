//! Participant of an evaluation: an agent, and for an adversary the attack on what it publishes.

use agent::agent::{Agent, AgentInput, Perception};
use agent::attack::Attack;
use agent::output_filter::OutputFilter;
use dataset::frame::Frame;
use perception::detector::DetectorError;
use protocol::{CavId, CodecConfig, EncodedFeatures, PointCloud, PoseEstimate, WireError};
use tch::Tensor;

use super::sent::Sent;

#[derive(Debug)]
pub(super) struct Participant {
    agent: Agent,
    attack: Option<Attack>,
}

impl Participant {
    pub(super) fn new(agent: Agent, attack: Option<Attack>) -> Self {
        Self { agent, attack }
    }

    pub(super) fn cav(&self) -> &CavId {
        self.agent.cav()
    }

    /// Passes on the last messages of another participant, which an attack may replay.
    pub(super) fn capture(&mut self, latest: Option<&Sent>) {
        if let Some(attack) = &mut self.attack {
            attack.capture(latest.map(Sent::captured).unwrap_or_default());
        }
    }

    /// The published pose.
    pub(super) fn pose(&mut self, input: &AgentInput<'_>) -> PoseEstimate {
        let pose = self.agent.estimate_pose(input);
        self.attack.as_ref().map_or(pose, |attack| attack.pose(pose))
    }

    /// The published map, confidence and detections, from a map `[1, C, H, W]` of the encoder where there is one.
    pub(super) fn perceive(&mut self, frame: &Frame, map: Option<&Tensor>) -> Result<Perception, DetectorError> {
        let perception = match map {
            Some(map) => self.agent.perceive_map(map),
            None => self.agent.perceive(&frame.points),
        }?;
        Ok(match &mut self.attack {
            Some(attack) => attack.perception(perception),
            None => perception,
        })
    }

    /// The published points.
    pub(super) fn points(&mut self, cloud: &PointCloud) -> PointCloud {
        let points = self.agent.share_points(cloud);
        match &mut self.attack {
            Some(attack) => attack.points(points),
            None => points,
        }
    }

    /// As [`Agent::write_map`].
    pub(super) fn write_map(
        &mut self,
        perception: Perception,
        codec: &CodecConfig,
        capture_nanos: u64,
    ) -> Result<EncodedFeatures, WireError> {
        self.agent.write_map(perception.features, &perception.confidence, codec, capture_nanos)
    }
}
