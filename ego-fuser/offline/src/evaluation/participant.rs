//! Participant of an evaluation: an agent with its settings.

use std::time::{Duration, Instant};

use agent::agent::{Agent, AgentInput};
use agent::agent_output::Perception;
use agent::config::AgentSettings;
use dataset::frame::Frame;
use fusion::method::Exchange;
use perception::detector::DetectorError;
use protocol::{CodecConfig, EncodedFeatures, PoseEstimate, StageTiming, Stream, WireError};
use tch::Tensor;

#[derive(Debug)]
pub(super) struct Participant {
    pub(super) agent: Agent,
    /// True if its network is not that of the run.
    has_own_network: bool,
    /// Encoding of its maps.
    codec: CodecConfig,
    /// Content that it publishes where a method needs feature maps.
    in_place_of_maps: Vec<Exchange>,
    /// Durations of the last sweep's pose.
    pub(super) times: PoseTimes,
    /// Stages of the last sweep's perception.
    pub(super) stages: Vec<StageTiming>,
}

/// Durations of the last sweep's pose.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct PoseTimes {
    /// Until the pose is published.
    pub(super) estimate: Duration,
    /// For the poses of later sweeps, after everything is published.
    pub(super) observe: Duration,
}

impl Participant {
    pub(super) fn new(agent: Agent, settings: &AgentSettings) -> Self {
        Self {
            agent,
            has_own_network: settings.weights.is_some(),
            codec: settings.codec,
            in_place_of_maps: { settings.sent_for(Stream::Bev).into_iter() }
                .map(|stream| match stream {
                    Stream::Boxes => Exchange::Boxes,
                    _ => Exchange::Features,
                })
                .collect(),
            times: PoseTimes::default(),
            stages: Vec::new(),
        }
    }

    /// Content that it publishes where a method needs `needed`, in the order of sending.
    pub(super) fn exchange(&self, needed: Exchange) -> Vec<Exchange> {
        match needed {
            Exchange::Features => self.in_place_of_maps.clone(),
            needed => vec![needed],
        }
    }

    /// The published pose.
    pub(super) fn pose(&mut self, input: &AgentInput<'_>) -> PoseEstimate {
        let began = Instant::now();
        let pose = self.agent.estimate_pose(input);
        self.times.estimate = began.elapsed();
        pose
    }

    /// Last step of a sweep.
    pub(super) fn observe(&mut self, input: &AgentInput<'_>) {
        let began = Instant::now();
        self.agent.observe(input);
        self.times.observe = began.elapsed();
    }

    /// The published map, confidence and detections, from a map `[1, C, H, W]` of the run's encoder where there is one.
    pub(super) fn perceive(
        &mut self,
        frame: &Frame,
        map: Option<&Tensor>,
    ) -> Result<Perception, DetectorError> {
        let perception = match map.filter(|_| !self.has_own_network) {
            Some(map) => self.agent.perceive_map(map),
            None => self.agent.perceive(&frame.points),
        }?;
        self.stages.clone_from(&perception.times);
        Ok(perception)
    }

    /// As [`Agent::write_map`].
    pub(super) fn write_map(
        &mut self,
        perception: Perception,
        capture_nanos: u64,
    ) -> Result<EncodedFeatures, WireError> {
        self.agent.write_map(
            perception.features,
            &perception.confidence,
            &self.codec,
            capture_nanos,
        )
    }
}
