//! Messages of a vehicle for a frame, as the ego receives them.

use std::collections::BTreeMap;

use agent::attack::CapturedMessages;
use dataset::frame::Frame;
use localization::pose_source::NO_SOURCE;
use protocol::{CavId, Limits, Message, PoseEstimate, RateChoice, Stream, WireError};

use ego_fuser::ego::{Content, View};

/// Messages of a vehicle for one frame.
#[derive(Debug, Clone)]
pub(super) struct Sent {
    pub(super) cav: CavId,
    pub(super) capture_nanos: u64,
    pub(super) pose: PoseEstimate,
    /// Bytes of the pose message.
    pub(super) pose_bytes: u64,
    /// Messages beside the pose, in the order of sending.
    pub(super) messages: Vec<SentMessage>,
    /// Reason why there is no message of a sweep that could not be computed.
    pub(super) failure: Option<String>,
}

/// Message beside the pose.
#[derive(Debug, Clone)]
pub(super) struct SentMessage {
    pub(super) content: Content,
    /// Bytes on the wire, header included.
    pub(super) bytes: u64,
    /// Decision of the rate control, where a map had to keep within a limit.
    pub(super) rate: Option<RateChoice>,
}

/// The messages of a sweep as they come in.
#[derive(Default)]
pub(super) struct Replies {
    pose: Option<(PoseEstimate, u64)>,
    messages: BTreeMap<Stream, SentMessage>,
    /// Reason why the sweep cannot be computed.
    pub(super) failure: Option<String>,
}

impl Replies {
    /// Takes a message of so many bytes on the wire.
    pub(super) fn note(&mut self, message: Message, bytes: u64) -> Result<(), WireError> {
        let mut rate = None;
        let content = match message {
            Message::Bev(message) => {
                rate = message.features.rate;
                Content::Features(message.features.decode(&Limits::DEFAULT)?)
            }
            Message::Boxes(message) => Content::Boxes(message.into_objects()),
            Message::Points(message) => Content::Points(message.points),
            Message::Pose(pose) => {
                self.pose = Some((pose, bytes));
                return Ok(());
            }
            _ => return Ok(()),
        };
        let stream = content.exchange().stream();
        let message = SentMessage {
            content,
            bytes,
            rate,
        };
        self.messages.insert(stream, message);
        Ok(())
    }

    /// True with a pose and a message of each of these streams.
    pub(super) fn is_complete(&self, streams: &[Stream]) -> bool {
        let mut streams = streams.iter();
        self.pose.is_some() && streams.all(|stream| self.messages.contains_key(stream))
    }

    /// The answer with its messages in the order of these streams, whatever the order of their arrival.
    pub(super) fn into_sent(mut self, frame: &Frame, streams: &[Stream]) -> Sent {
        let (pose, pose_bytes) = self.pose.unwrap_or((NO_SOURCE, 0));
        let streams = streams.iter();
        let messages = streams.filter_map(|stream| self.messages.remove(stream));
        Sent {
            cav: frame.cav.clone(),
            capture_nanos: frame.capture_nanos,
            pose,
            pose_bytes,
            messages: messages.collect(),
            failure: self.failure,
        }
    }
}

impl Sent {
    /// A message as received by the ego.
    pub(super) fn view(&self, content: Content) -> View {
        View {
            cav: self.cav.clone(),
            pose: self.pose,
            capture_nanos: self.capture_nanos,
            content,
        }
    }

    /// The messages as received by the ego.
    pub(super) fn into_views(mut self) -> Vec<View> {
        let messages = std::mem::take(&mut self.messages).into_iter();
        messages.map(|message| self.view(message.content)).collect()
    }

    /// As captured by a vehicle that replays it.
    pub(super) fn captured(&self) -> CapturedMessages {
        let mut captured = CapturedMessages::default();
        for message in &self.messages {
            match message.content.clone() {
                Content::Features(map) => captured.features = Some(map.features),
                Content::Boxes(objects) => {
                    let detections = objects.into_iter().map(|object| object.detection);
                    captured.detections = Some(detections.collect());
                }
                Content::Points(points) => captured.points = Some(points),
            }
        }
        captured
    }
}
