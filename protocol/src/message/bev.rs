//! BEV feature map of an agent, with pose, grid and codec.

use serde::{Deserialize, Serialize};

use super::{Payload, PoseEstimate, check_limit, private};
use crate::{
    BevGrid, Body, BodyShape, Codec, EncodedFeatures, Kind, Limits, RateChoice, WireError,
};

/// A BEV feature map: agent to ego, for intermediate fusion.
///
/// Body: the map in the format of its codec, see [`crate::codec`].
#[derive(Debug, Clone, PartialEq)]
pub struct Bev {
    /// Pose of the sender: repeated from its `pose` message, so that each message is self-contained.
    pub pose: PoseEstimate,
    /// The feature map, in the frame of the sender's LiDAR.
    pub features: EncodedFeatures,
}

/// Metadata of [`Bev`].
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct BevMetadata {
    /// Pose of the sender.
    pub pose: PoseEstimate,
    /// BEV grid of the map.
    pub grid: BevGrid,
    /// Channels of the map.
    pub channels: u32,
    /// Channels of the map before a learnt compressor, if one was used.
    pub code_of: Option<u32>,
    /// Format of the body.
    pub codec: Codec,
    /// Reason for this format, if the message had to keep within a limit.
    pub rate: Option<RateChoice>,
}

impl private::Sealed for Bev {}

impl Payload for Bev {
    const KIND: Kind = Kind::Bev;
    type Metadata = BevMetadata;

    fn into_parts(self) -> (BevMetadata, Body) {
        let Self {
            pose,
            features:
                EncodedFeatures {
                    grid,
                    channels,
                    code_of,
                    codec,
                    rate,
                    body,
                },
        } = self;
        (
            BevMetadata {
                pose,
                grid,
                channels,
                code_of,
                codec,
                rate,
            },
            body,
        )
    }

    fn check(metadata: &BevMetadata, limits: &Limits) -> Result<BodyShape, WireError> {
        metadata.pose.check_values(limits)?;
        check_code(metadata.channels, metadata.code_of, limits)?;
        EncodedFeatures::body_shape(&metadata.grid, metadata.channels, &metadata.codec, limits)
    }

    fn from_parts(metadata: BevMetadata, body: Body) -> Result<Self, WireError> {
        let BevMetadata {
            pose,
            grid,
            channels,
            code_of,
            codec,
            rate,
        } = metadata;
        Ok(Self {
            pose,
            features: EncodedFeatures {
                grid,
                channels,
                code_of,
                codec,
                rate,
                body,
            },
        })
    }
}

/// A code has no more channels than the map that it encodes, and the map no more than permitted.
fn check_code(channels: u32, code_of: Option<u32>, limits: &Limits) -> Result<(), WireError> {
    let Some(decoded) = code_of else {
        return Ok(());
    };
    check_limit("channels", decoded.into(), limits.max_channels.into())?;
    if channels > decoded {
        let (expected, found) = (decoded.into(), channels.into());
        return Err(WireError::Shape {
            what: "channels of a code",
            expected,
            found,
        });
    }
    Ok(())
}
