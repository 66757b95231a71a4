//! View: one vehicle's decoded message for a frame.

use protocol::{CavId, DecodedFeatures, Detection, PerceivedObject, PointCloud, PoseEstimate};

use fusion::method::Exchange;

/// One vehicle's perception as received.
#[derive(Debug, Clone, PartialEq)]
pub struct View {
    /// Sender.
    pub cav: CavId,
    /// Pose that the sender reported.
    pub pose: PoseEstimate,
    /// Capture time of the sweep, nanoseconds.
    pub capture_nanos: u64,
    /// Content in the sender's own LiDAR frame.
    pub content: Content,
}

impl View {
    /// Age relative to another view, nanoseconds.
    pub fn age_nanos(&self, newer: &Self) -> i64 {
        newer.capture_nanos as i64 - self.capture_nanos as i64
    }
}

/// Transmitted content, by method.
#[derive(Debug, Clone, PartialEq)]
pub enum Content {
    /// A feature map: `none`, and all methods of intermediate fusion.
    Features(DecodedFeatures),
    /// Detected objects: `late`, and methods with a box input.
    Boxes(Vec<PerceivedObject>),
    /// Points, without those on the sender's own body: `early`.
    Points(PointCloud),
}

impl Content {
    /// Exchange that transmits this content.
    pub fn exchange(&self) -> Exchange {
        match self {
            Self::Features(_) => Exchange::Features,
            Self::Boxes(_) => Exchange::Boxes,
            Self::Points(_) => Exchange::Points,
        }
    }

    /// Its objects, none of other content.
    pub(crate) fn objects(&self) -> &[PerceivedObject] {
        match self {
            Self::Boxes(objects) => objects,
            _ => &[],
        }
    }

    /// Their detections.
    pub(crate) fn detections(&self) -> impl Iterator<Item = &Detection> {
        self.objects().iter().map(|object| &object.detection)
    }
}
