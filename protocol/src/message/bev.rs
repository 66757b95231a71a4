//! BEV feature map of an agent, with pose, grid and codec.

use std::mem;

use serde::{Deserialize, Serialize};

use super::{Payload, PoseEstimate, check_limit, private};
use crate::{Body, BodyShape, EncodedFeatures, Kind, Limits, Result, WireError};

/// A BEV feature map: agent to ego, for intermediate fusion.
///
/// Body: the map in the format of its codec, see [`crate::codec`].
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Bev {
    /// Pose of the sender: repeated from its `pose` message, so that each message is self-contained.
    pub pose: PoseEstimate,
    /// The feature map, in the frame of the sender's LiDAR.
    pub features: EncodedFeatures,
}

impl private::Sealed for Bev {}

impl Payload for Bev {
    const KIND: Kind = Kind::Bev;
    // The body of its features is not serialized.
    type Metadata = Self;

    fn into_parts(mut self) -> (Self, Body) {
        let body = mem::take(&mut self.features.body);
        (self, body)
    }

    fn check(metadata: &Self, limits: &Limits) -> Result<BodyShape> {
        let features = &metadata.features;
        metadata.pose.check_values(limits)?;
        if let Some(decoded) = features.code_of.map(u64::from) {
            check_limit("channels", decoded, limits.max_channels.into())?;
            // A code has no more channels than the map that it encodes.
            if u64::from(features.channels) > decoded {
                let found = features.channels.into();
                return Err(WireError::shape("channels of a code", decoded, found));
            }
        }
        EncodedFeatures::body_shape(&features.grid, features.channels, &features.codec, limits)
    }

    fn from_parts(mut metadata: Self, body: Body) -> Result<Self> {
        metadata.features.body = body;
        Ok(metadata)
    }
}
