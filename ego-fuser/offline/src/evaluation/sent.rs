//! Messages of a vehicle for a frame, encoded and decoded as in a live run.

use agent::agent::AgentInput;
use agent::attack::CapturedMessages;
use dataset::frame::Frame;
use protocol::message::{Bev, Boxes, Payload, Points};
use protocol::{
    CavId, HEADER_LEN, Header, Limits, PoseEstimate, RateChoice, Stamp, WireError, wire,
};
use tch::Tensor;

use super::EvaluateError;
use super::participant::Participant;
use ego_fuser::ego::{Content, View};
use fusion::method::Exchange;

/// Messages of a vehicle for one frame.
#[derive(Debug)]
pub(super) struct Sent {
    pub(super) cav: CavId,
    pub(super) capture_nanos: u64,
    pub(super) pose: PoseEstimate,
    pub(super) content: Option<Content>,
    pub(super) payload_bytes: u64,
    pub(super) wire_bytes: u64,
    /// Of these, the bytes of the pose message.
    pub(super) pose_bytes: u64,
    /// Decision of the rate control, where a map had to keep within a limit.
    pub(super) rate: Option<RateChoice>,
}

impl Sent {
    /// As received by the ego; absent where nothing was sent.
    pub(super) fn view(&self) -> Option<View> {
        let Self {
            cav,
            capture_nanos,
            pose,
            content,
            ..
        } = self;
        Some(View {
            cav: cav.clone(),
            pose: *pose,
            capture_nanos: *capture_nanos,
            content: content.clone()?,
        })
    }

    /// As received by the ego; absent where nothing was sent.
    pub(super) fn into_view(self) -> Option<ego_fuser::ego::View> {
        let Self {
            cav,
            capture_nanos,
            pose,
            content,
            ..
        } = self;
        Some(ego_fuser::ego::View {
            cav,
            pose,
            capture_nanos,
            content: content?,
        })
    }

    /// As captured by a vehicle that replays it.
    pub(super) fn captured(&self) -> CapturedMessages {
        let mut captured = CapturedMessages::default();
        match self.content.clone() {
            Some(Content::Features(map)) => captured.features = Some(map.features),
            Some(Content::Boxes(found)) => captured.detections = Some(found),
            Some(Content::Points(points)) => captured.points = Some(points),
            None => {}
        }
        captured
    }

    /// The same, with payload and wire bytes.
    pub(super) fn received(&self) -> Option<(View, (u64, u64))> {
        Some((self.view()?, (self.payload_bytes, self.wire_bytes)))
    }
}

/// Messages of a vehicle for a frame: its pose and, with `exchange`, its perception.
///
/// # Errors
/// [`EvaluateError`] when it cannot perceive, encode or decode its own message.
pub(super) fn view(
    participant: &mut Participant,
    frame: &Frame,
    map: Option<&Tensor>,
    exchange: Option<Exchange>,
) -> Result<Sent, EvaluateError> {
    let input = AgentInput {
        capture_nanos: frame.capture_nanos,
        cloud: &frame.points,
        measured_pose: frame.world_from_lidar.as_ref(),
        motion: frame.motion(),
    };
    let pose = participant.pose(&input);
    // Nothing of this sweep depends on it.
    participant.observe(&input);
    let stamp = stamp(participant.cav(), frame.capture_nanos);
    let (_, pose_bytes) = through_the_wire(&stamp, pose)?;
    let sent = |content, payload_bytes, wire_bytes| Sent {
        cav: frame.cav.clone(),
        capture_nanos: frame.capture_nanos,
        pose,
        content,
        payload_bytes,
        wire_bytes,
        pose_bytes,
        rate: None,
    };
    let (content, bytes) = match exchange {
        None => return Ok(sent(None, 0, 0)),
        Some(Exchange::Points) => {
            let points = participant.points(&frame.points);
            let (message, bytes) = through_the_wire(&stamp, Points { pose, points })?;
            (Content::Points(message.points), bytes)
        }
        Some(Exchange::Boxes) => {
            let detections = participant.perceive(frame, map)?.detections;
            let (message, bytes) = through_the_wire(&stamp, Boxes { pose, detections })?;
            (Content::Boxes(message.detections), bytes)
        }
        Some(Exchange::Features | Exchange::Nothing) => {
            let perception = participant.perceive(frame, map)?;
            let features = participant.write_map(perception, frame.capture_nanos)?;
            let (message, bytes) = through_the_wire(&stamp, Bev { pose, features })?;
            let rate = message.features.rate;
            let content = Content::Features(message.features.decode(&Limits::default())?);
            let sent = sent(Some(content), bytes - HEADER_LEN as u64, bytes + pose_bytes);
            return Ok(Sent { rate, ..sent });
        }
    };
    Ok(sent(
        Some(content),
        bytes - HEADER_LEN as u64,
        bytes + pose_bytes,
    ))
}

/// Encodes and decodes a message; returns its size on the wire too.
fn through_the_wire<M: Payload>(stamp: &Stamp, message: M) -> Result<(M, u64), WireError> {
    let encoded = wire::encode(stamp, message)?;
    let bytes = encoded
        .pieces()
        .iter()
        .map(|piece| piece.len() as u64)
        .sum();
    let (_, message): (Header, M) = wire::decode(encoded.pieces(), &Limits::default())?;
    Ok((message, bytes))
}

/// Sender and capture time of a sweep's messages, stamped at the capture time.
pub(super) fn stamp(cav: &CavId, capture_nanos: u64) -> Stamp {
    Stamp {
        cav: cav.clone(),
        epoch: 0,
        sequence: 0,
        capture_nanos,
        publish_nanos: capture_nanos,
    }
}
