//! What the vehicles of a frame tell the ego.

use protocol::{CavId, DecodedFeatures, Detection, PointCloud, PoseEstimate};

use fusion::method::Exchange;

/// What one vehicle sees, as it arrived.
#[derive(Debug, Clone, PartialEq)]
pub struct View {
    /// Who.
    pub cav: CavId,
    /// Where it believes to be.
    pub pose: PoseEstimate,
    /// Capture time of the sweep, nanoseconds.
    pub capture_nanos: u64,
    /// What it sees, in its own LiDAR frame.
    pub content: Content,
}

impl View {
    /// How much older it is than another, nanoseconds.
    #[must_use]
    pub fn age_nanos(&self, newer: &Self) -> i64 {
        newer.capture_nanos as i64 - self.capture_nanos as i64
    }
}

/// What crosses the air, by method.
#[derive(Debug, Clone, PartialEq)]
pub enum Content {
    /// A feature map: `none`, and all methods of intermediate fusion.
    Features(DecodedFeatures),
    /// Detections: `late`.
    Boxes(Vec<Detection>),
    /// Points, without those on the sender's own body: `early`.
    Points(PointCloud),
}

impl Content {
    /// What has to be exchanged for it.
    #[must_use]
    pub fn exchange(&self) -> Exchange {
        match self {
            Self::Features(_) => Exchange::Features,
            Self::Boxes(_) => Exchange::Boxes,
            Self::Points(_) => Exchange::Points,
        }
    }
}
