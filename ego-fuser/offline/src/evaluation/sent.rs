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
    pub(super) content: Option<Content>,
    pub(super) payload_bytes: u64,
    pub(super) wire_bytes: u64,
    /// Of these, the bytes of the pose message.
    pub(super) pose_bytes: u64,
    /// Reason why there is no content of a sweep that could not be computed.
    pub(super) failure: Option<String>,
    /// Decision of the rate control, where a map had to keep within a limit.
    pub(super) rate: Option<RateChoice>,
}

impl Sent {
    /// As received by the ego; absent where nothing was sent.
    pub(super) fn into_view(self) -> Option<View> {
        Some(View {
            cav: self.cav,
            pose: self.pose,
            capture_nanos: self.capture_nanos,
            content: self.content?,
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
}
