//! Parts of a frame before Python sees them: collected from messages in any order, or read from a data set.

use std::sync::Arc;

use dataset::Scenario;
use dataset::evaluation_protocol::EvaluationProtocol;
use dataset::frame::Frame;
use protocol::{
    Boxes, CavId, Detections, Handedness, Header, Limits, Message, Pose, PoseEstimate, Stream,
    Topic, Tracks, Truth, WireError, wire,
};

use crate::payload::DecodedBev;

/// One capture time of a run or scenario.
pub(crate) struct FrameParts {
    /// Name of the run or scenario.
    pub(crate) source: String,
    /// Tick of the scene, from 0.
    pub(crate) tick: Option<u64>,
    pub(crate) capture_nanos: u64,
    pub(crate) agents: Vec<AgentParts>,
    /// Results of egos.
    pub(crate) detections: Vec<Detections>,
    /// Tracks of egos.
    pub(crate) tracks: Vec<Tracks>,
    /// The ego of all frames of the scenario or recording; `None`: that of the first result, or the first agent.
    pub(crate) ego: Option<String>,
    /// Scenario of a data set, from which follows who takes part; `None`: all do, as in a run.
    pub(crate) scenario: Option<Arc<Scenario>>,
    /// Reasons for which parts were left out.
    pub(crate) problems: Vec<String>,
    /// The rule of the ground truth.
    pub(crate) protocol: EvaluationProtocol,
}

/// One agent at one capture time.
pub(crate) struct AgentParts {
    /// Sensor data and ground truth.
    pub(crate) recorded: Frame,
    /// True if there is a sweep, which may have no point.
    pub(crate) has_points: bool,
    pub(crate) gnss_world_from_lidar: Option<Pose>,
    pub(crate) pose: Option<PoseEstimate>,
    pub(crate) bev: Option<DecodedBev>,
    pub(crate) boxes: Option<Boxes>,
}

impl FrameParts {
    /// No message yet.
    pub(crate) fn empty(source: &str, capture_nanos: u64, protocol: &EvaluationProtocol) -> Self {
        Self {
            source: source.to_owned(),
            tick: None,
            capture_nanos,
            agents: Vec::new(),
            detections: Vec::new(),
            tracks: Vec::new(),
            ego: None,
            scenario: None,
            problems: Vec::new(),
            protocol: protocol.clone(),
        }
    }

    /// Adds a message of a topic that frames hold ([`is_part_of_frames`]). Of two messages of one topic the first is
    /// kept: the second is of another replay of the same scene.
    pub(crate) fn add<'a>(
        &mut self,
        topic: &Topic,
        pieces: impl IntoIterator<Item = &'a [u8]>,
    ) -> Result<(), WireError> {
        match topic {
            Topic::Truth => {
                let (_, truth) = wire::decode::<Truth>(pieces, &Limits::DEFAULT)?;
                self.add_truth(&truth);
            }
            Topic::Stream { cav, stream } => match decode_stream(cav, *stream, pieces)?.1 {
                Message::Detections(found)
                    if !self.detections.iter().any(|known| known.ego == found.ego) =>
                {
                    self.detections.push(found);
                }
                Message::Tracks(found)
                    if !self.tracks.iter().any(|known| known.ego == found.ego) =>
                {
                    self.tracks.push(found);
                }
                message => self.agent(cav).take(*stream, message)?,
            },
            _ => {}
        }
        Ok(())
    }

    /// Agents are in the order of the scene: the ego comes first.
    fn add_truth(&mut self, truth: &Truth) {
        if self.tick.is_some() {
            return;
        }
        self.tick = Some(truth.tick);
        let mut others = std::mem::take(&mut self.agents);
        for agent in &truth.agents {
            let truth = Frame::of_truth(agent);
            let known = others
                .iter()
                .position(|other| other.recorded.cav == agent.cav);
            let known = known.map(|index| others.swap_remove(index));
            let mut parts = known.unwrap_or_else(|| AgentParts::empty(&agent.cav));
            parts.recorded.world_from_lidar = truth.world_from_lidar;
            parts.recorded.objects = truth.objects;
            self.agents.push(parts);
        }
        self.agents.append(&mut others);
    }

    fn agent(&mut self, cav: &CavId) -> &mut AgentParts {
        let mut agents = self.agents.iter();
        let known = agents.position(|agent| agent.recorded.cav == *cav);
        let index = known.unwrap_or_else(|| {
            self.agents.push(AgentParts::empty(cav));
            self.agents.len() - 1
        });
        &mut self.agents[index]
    }
}

impl AgentParts {
    fn empty(cav: &CavId) -> Self {
        Self::recorded(Frame::empty(cav.clone(), 0, Handedness::Right), false)
    }

    /// An agent of a data set, or of a message of the ground truth.
    pub(crate) fn recorded(recorded: Frame, has_points: bool) -> Self {
        let gnss_world_from_lidar = recorded.gnss_world_from_lidar();
        Self {
            recorded,
            has_points,
            gnss_world_from_lidar,
            pose: None,
            bev: None,
            boxes: None,
        }
    }

    /// An agent with points that it shares.
    pub(crate) fn of_points(cav: &CavId, shared: protocol::Points) -> Self {
        let mut parts = Self::empty(cav);
        (parts.recorded.points, parts.has_points, parts.pose) =
            (shared.points, true, Some(shared.pose));
        parts
    }

    fn take(&mut self, stream: Stream, message: Message) -> Result<(), WireError> {
        let frame = &mut self.recorded;
        match (message, stream) {
            (
                Message::Lidar(protocol::Lidar { points })
                | Message::Points(protocol::Points { points, .. }),
                _,
            ) if !self.has_points => {
                (frame.points, self.has_points) = (points, true);
            }
            (Message::Radar(sweep), _) => frame.radar = frame.radar.take().or(Some(sweep.points)),
            (Message::Gnss(gnss), _) => {
                self.gnss_world_from_lidar =
                    self.gnss_world_from_lidar.or(Some(gnss.world_from_lidar));
            }
            (Message::Imu(motion), _)
                if frame.speed_mps.is_none() && frame.yaw_rate_rad_s.is_none() =>
            {
                (frame.speed_mps, frame.yaw_rate_rad_s) = (motion.speed_mps, motion.yaw_rate_rad_s);
            }
            (Message::Camera(camera), Stream::Camera(number))
                if { frame.cameras.iter() }.all(|(known, _)| *known != number) =>
            {
                frame.cameras.push((number, camera))
            }
            (Message::Pose(pose), _) => self.pose = self.pose.or(Some(pose)),
            (Message::Bev(bev), _) if self.bev.is_none() => {
                self.bev = Some(DecodedBev::decode(bev)?)
            }
            (Message::Boxes(boxes), _) => self.boxes = self.boxes.take().or(Some(boxes)),
            _ => {}
        }
        Ok(())
    }
}

/// True for topics whose messages are part of frames. What reaches an ego over an emulated link is not: it is the same
/// message, later or not at all.
pub(crate) fn is_part_of_frames(topic: &Topic) -> bool {
    !matches!(topic, Topic::Received { .. }) && topic.is_counted() && !topic.is_json()
}

/// Decodes a message of a vehicle's stream and checks that it is of that vehicle and of that stream's kind.
pub(crate) fn decode_stream<'a>(
    cav: &CavId,
    stream: Stream,
    pieces: impl IntoIterator<Item = &'a [u8]>,
) -> Result<(Header, Message), WireError> {
    let (header, message) = wire::decode_any(pieces, &Limits::DEFAULT)?;
    header.check_sender(cav)?;
    stream
        .kind()
        .map_or(Ok(()), |kind| header.check_kind(kind))?;
    Ok((header, message))
}
