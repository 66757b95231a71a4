//! Transmission of a vehicle's messages for a frame: encoded and decoded as in a live run.

use agent::agent::AgentInput;
use dataset::frame::Frame;
use protocol::message::{Bev, Boxes, Payload, Points};
use protocol::{
    CavId, HEADER_LEN, Header, Limits, PoseEstimate, RateChoice, Stamp, WireError, wire,
};
use tch::Tensor;

use super::EvaluateError;
use super::participant::Participant;
use super::sent::Sent;
use ego_fuser::ego::Content;
use fusion::method::Exchange;

/// Messages of a vehicle for a frame: its pose and, with `exchange`, its perception. A sweep that cannot be computed
/// gives no content.
///
/// # Errors
/// [`EvaluateError`] when it cannot perceive any sweep, or encode or decode its own message.
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
    let sent = Sent {
        cav: frame.cav.clone(),
        capture_nanos: frame.capture_nanos,
        pose,
        content: None,
        payload_bytes: 0,
        wire_bytes: 0,
        pose_bytes,
        failure: None,
        rate: None,
    };
    let Some(exchange) = exchange else {
        return Ok(sent);
    };
    match perceived(participant, frame, map, exchange, (&stamp, pose)) {
        Ok((content, rate, bytes)) => Ok(Sent {
            content: Some(content),
            payload_bytes: bytes - HEADER_LEN as u64,
            wire_bytes: bytes + pose_bytes,
            rate,
            ..sent
        }),
        Err(error) if error.is_of_frame() => Ok(Sent {
            failure: Some(error.to_string()),
            ..sent
        }),
        Err(error) => Err(error),
    }
}

/// Content of a vehicle's message as received, the decision of the rate control, and the bytes of the message.
fn perceived(
    participant: &mut Participant,
    frame: &Frame,
    map: Option<&Tensor>,
    exchange: Exchange,
    (stamp, pose): (&Stamp, PoseEstimate),
) -> Result<(Content, Option<RateChoice>, u64), EvaluateError> {
    match exchange {
        Exchange::Points => {
            let points = participant.points(&frame.points);
            let (message, bytes) = through_the_wire(stamp, Points { pose, points })?;
            Ok((Content::Points(message.points), None, bytes))
        }
        Exchange::Boxes => {
            let detections = participant.perceive(frame, map)?.detections;
            let (message, bytes) = through_the_wire(stamp, Boxes { pose, detections })?;
            Ok((Content::Boxes(message.detections), None, bytes))
        }
        Exchange::Features | Exchange::Nothing => {
            let perception = participant.perceive(frame, map)?;
            let features = participant.write_map(perception, frame.capture_nanos)?;
            let (message, bytes) = through_the_wire(stamp, Bev { pose, features })?;
            let rate = message.features.rate;
            let content = Content::Features(message.features.decode(&Limits::default())?);
            Ok((content, rate, bytes))
        }
    }
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
