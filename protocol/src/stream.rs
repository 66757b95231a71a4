//! Streams of one vehicle: the last chunks of its keys.

use std::fmt;
use std::str::FromStr;

use serde::{Deserialize, Serialize};

use crate::string_enum::written_as_text;
use crate::{KeyError, Kind};

/// A stream of one vehicle.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(try_from = "String", into = "String")]
#[cfg_attr(feature = "config", derive(schemars::JsonSchema))]
pub enum Stream {
    /// `lidar`: sweeps.
    Lidar,
    /// `@preview`: a few points of every sweep, for viewers. A subscription to all keys does not match a chunk that
    /// begins with `@`: a recording has whole sweeps.
    Preview,
    /// `gnss`: recorded or GNSS poses.
    Gnss,
    /// `imu`: speed and yaw rate that the vehicle measures itself.
    Imu,
    /// `camera/<k>`: images of camera `k`.
    Camera(u8),
    /// `radar`: radar sweeps.
    Radar,
    /// `pose`: pose estimates.
    Pose,
    /// `bev`: feature maps.
    Bev,
    /// `boxes`: detections of one vehicle from its own sensors.
    Boxes,
    /// `points`: raw points, for the early-fusion baseline only.
    Points,
    /// `pace`: the sweeps that an ego has time for.
    Pace,
    /// `descriptor`: model and streams of the vehicle.
    Descriptor,
    /// `detections`: detections of an ego.
    Detections,
    /// `detections/json`: the same as JSON.
    DetectionsJson,
}

impl Stream {
    /// The kind of the messages on this stream; `None` if they do not have this wire format.
    #[must_use]
    pub fn kind(self) -> Option<Kind> {
        Some(match self {
            Self::Lidar | Self::Preview => Kind::Lidar,
            Self::Gnss => Kind::Gnss,
            Self::Imu => Kind::Imu,
            Self::Camera(_) => Kind::Camera,
            Self::Radar => Kind::Radar,
            Self::Pose => Kind::Pose,
            Self::Bev => Kind::Bev,
            Self::Boxes => Kind::Boxes,
            Self::Points => Kind::Points,
            Self::Pace => Kind::Pace,
            Self::Descriptor => Kind::Descriptor,
            Self::Detections => Kind::Detections,
            Self::DetectionsJson => return None,
        })
    }

    /// Limit of the size of a message of this stream, bytes; `None`: limited by the transport only. For processes that
    /// forward messages without reading them.
    pub(crate) fn most_bytes(self) -> Option<usize> {
        match self {
            Self::Pose | Self::Gnss | Self::Imu | Self::Pace => Some(16 << 10),
            Self::Preview => Some(64 << 10),
            Self::Descriptor | Self::Boxes | Self::Detections => Some(4 << 20),
            Self::Lidar
            | Self::Camera(_)
            | Self::Radar
            | Self::Bev
            | Self::Points
            | Self::DetectionsJson => None,
        }
    }

    /// Reads the chunks of a key that name a stream.
    pub(crate) fn from_chunks(chunks: &[&str]) -> Option<Self> {
        Some(match chunks {
            ["lidar"] => Self::Lidar,
            ["@preview"] => Self::Preview,
            ["gnss"] => Self::Gnss,
            ["imu"] => Self::Imu,
            ["camera", index] => Self::Camera(camera_index(index)?),
            ["radar"] => Self::Radar,
            ["pose"] => Self::Pose,
            ["bev"] => Self::Bev,
            ["boxes"] => Self::Boxes,
            ["points"] => Self::Points,
            ["pace"] => Self::Pace,
            ["descriptor"] => Self::Descriptor,
            ["detections"] => Self::Detections,
            ["detections", "json"] => Self::DetectionsJson,
            _ => return None,
        })
    }
}

/// One camera has one spelling: no sign, no leading zero.
fn camera_index(text: &str) -> Option<u8> {
    let index: u8 = text.parse().ok()?;
    (index.to_string() == text).then_some(index)
}

impl fmt::Display for Stream {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Lidar => f.write_str("lidar"),
            Self::Preview => f.write_str("@preview"),
            Self::Gnss => f.write_str("gnss"),
            Self::Imu => f.write_str("imu"),
            Self::Camera(index) => write!(f, "camera/{index}"),
            Self::Radar => f.write_str("radar"),
            Self::Pose => f.write_str("pose"),
            Self::Bev => f.write_str("bev"),
            Self::Boxes => f.write_str("boxes"),
            Self::Points => f.write_str("points"),
            Self::Pace => f.write_str("pace"),
            Self::Descriptor => f.write_str("descriptor"),
            Self::Detections => f.write_str("detections"),
            Self::DetectionsJson => f.write_str("detections/json"),
        }
    }
}

impl FromStr for Stream {
    type Err = KeyError;

    fn from_str(text: &str) -> Result<Self, KeyError> {
        let chunks: Vec<&str> = text.splitn(3, '/').collect();
        Self::from_chunks(&chunks).ok_or_else(|| KeyError::unknown(text))
    }
}

written_as_text!(Stream);
