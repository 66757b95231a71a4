//! Messages of a vehicle for a frame, as the ego receives them.

use agent::attack::CapturedMessages;
use protocol::{CavId, PoseEstimate, RateChoice};

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

impl SentMessage {
    /// A message that had to keep within no limit.
    pub(super) fn new(content: Content, bytes: u64) -> Self {
        Self {
            content,
            bytes,
            rate: None,
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
