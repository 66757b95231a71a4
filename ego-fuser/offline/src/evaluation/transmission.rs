//! Transmission of a vehicle's messages for a frame: encoded and decoded as in a live run.

use agent::agent::AgentInput;
use dataset::frame::Frame;
use protocol::message::{Bev, Payload, Points};
use protocol::{CavId, Header, Limits, PoseEstimate, Stamp, WireError, wire};
use tch::Tensor;

use super::EvaluateError;
use super::participant::Participant;
use super::sent::{Sent, SentMessage};
use ego_fuser::ego::Content;
use fusion::method::Exchange;

/// Messages of a vehicle for a frame: its pose and its perception in each form of `exchange`. A sweep that cannot be
/// computed gives none.
///
/// # Errors
/// [`EvaluateError`] when it cannot perceive any sweep, or encode or decode its own message.
pub(super) fn view(
    participant: &mut Participant,
    frame: &Frame,
    map: Option<&Tensor>,
    exchange: &[Exchange],
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
    let stamp = stamp(participant.agent.cav(), frame.capture_nanos);
    let (_, pose_bytes) = through_the_wire(&stamp, pose)?;
    let mut sent = Sent {
        cav: frame.cav.clone(),
        capture_nanos: frame.capture_nanos,
        pose,
        pose_bytes,
        messages: Vec::new(),
        failure: None,
    };
    match perceived(participant, frame, map, exchange, (&stamp, pose)) {
        Ok(messages) => sent.messages = messages,
        Err(error) if error.is_of_frame() => sent.failure = Some(error.to_string()),
        Err(error) => return Err(error),
    }
    Ok(sent)
}

/// Messages of a vehicle beside its pose, as received; boxes before the map, as an agent sends them.
fn perceived(
    participant: &mut Participant,
    frame: &Frame,
    map: Option<&Tensor>,
    exchange: &[Exchange],
    (stamp, pose): (&Stamp, PoseEstimate),
) -> Result<Vec<SentMessage>, EvaluateError> {
    let mut messages = Vec::with_capacity(exchange.len());
    if exchange.contains(&Exchange::Points) {
        let points = participant.agent.share_points(&frame.points);
        let (message, bytes) = through_the_wire(stamp, Points { pose, points })?;
        messages.push(SentMessage::new(Content::Points(message.points), bytes));
    }
    if exchange.iter().all(|form| *form == Exchange::Points) {
        return Ok(messages);
    }
    let perception = participant.perceive(frame, map)?;
    if exchange.contains(&Exchange::Boxes) {
        let detections = perception.detections.clone();
        let boxes = (participant.agent).boxes(frame.capture_nanos, pose, detections);
        let (message, bytes) = through_the_wire(stamp, boxes)?;
        let content = Content::Boxes(message.into_objects());
        messages.push(SentMessage::new(content, bytes));
    }
    // An ego without an exchange has its own map.
    let sends_map = |form| matches!(form, &Exchange::Features | &Exchange::Nothing);
    if exchange.iter().any(sends_map) {
        let features = participant.write_map(perception, frame.capture_nanos)?;
        let (message, bytes) = through_the_wire(stamp, Bev { pose, features })?;
        let rate = message.features.rate;
        let map = message.features.decode(&Limits::default())?;
        let message = SentMessage::new(Content::Features(map), bytes);
        messages.push(SentMessage { rate, ..message });
    }
    Ok(messages)
}

/// Encodes and decodes a message; returns its size on the wire too.
fn through_the_wire<M: Payload>(stamp: &Stamp, message: M) -> Result<(M, u64), WireError> {
    let encoded = wire::encode(stamp, message)?;
    let (_, message): (Header, M) = wire::decode(encoded.pieces(), &Limits::default())?;
    Ok((message, encoded.wire_bytes() as u64))
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
