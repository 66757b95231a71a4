//! Camera images, encoded as the data set stores them, with the calibration that relates them to the LiDAR.

use serde::{Deserialize, Serialize};

use super::{Payload, check_pose, check_within, private, wrong_body};
use crate::{Body, BodyShape, Kind, Limits, Pose, WireError};

/// Largest edge of an image, pixels.
const MAX_EDGE_PX: f64 = 16_384.0;

/// Encoding of an image.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize, strum::IntoStaticStr)]
#[strum(serialize_all = "lowercase")]
#[serde(rename_all = "snake_case")]
pub enum ImageFormat {
    /// Portable Network Graphics.
    Png,
    /// JPEG.
    Jpeg,
}

impl ImageFormat {
    /// Its name in `sensor_msgs/CompressedImage` and in file names.
    pub fn name(self) -> &'static str {
        self.into()
    }

    /// The format of a file by its first bytes.
    pub fn of_bytes(bytes: &[u8]) -> Option<Self> {
        match bytes {
            [0x89, b'P', b'N', b'G', ..] => Some(Self::Png),
            [0xff, 0xd8, 0xff, ..] => Some(Self::Jpeg),
            _ => None,
        }
    }
}

/// Pinhole camera: a point at (x, y, z) of its frame, z ahead, x right, y down, is at column
/// `fx * x / z + cx` and row `fy * y / z + cy`.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Pinhole {
    /// Focal length along the rows, pixels.
    pub fx_px: f64,
    /// Focal length along the columns, pixels.
    pub fy_px: f64,
    /// Column of the optical axis, pixels.
    pub cx_px: f64,
    /// Row of the optical axis, pixels.
    pub cy_px: f64,
}

/// Calibration of an image.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct CameraMetadata {
    /// Encoding of the image.
    pub format: ImageFormat,
    /// Columns.
    pub width_px: u32,
    /// Rows.
    pub height_px: u32,
    /// Projection; `None` if the data set gives none.
    pub pinhole: Option<Pinhole>,
    /// Pose of the camera (z ahead, x right, y down) in the LiDAR's frame; `None` if the data set gives none.
    pub lidar_from_camera: Option<Pose>,
}

/// An image of one camera: replay to viewers and recorders.
///
/// Body: the encoded image, as it is in its file.
#[derive(Debug, Clone, PartialEq)]
pub struct Camera {
    /// Size, encoding and calibration.
    pub metadata: CameraMetadata,
    /// The encoded image.
    pub image: Vec<u8>,
}

impl Pinhole {
    /// Column and row of a point of the camera's frame, pixels; `None` for a point that is not ahead of it.
    pub fn project(&self, [x, y, z]: [f64; 3]) -> Option<[f64; 2]> {
        (z > 0.0).then(|| {
            [
                self.fx_px * x / z + self.cx_px,
                self.fy_px * y / z + self.cy_px,
            ]
        })
    }

    fn check_values(&self) -> Result<(), WireError> {
        check_within("fx_px", self.fx_px, 1e-3, 1e6)?;
        check_within("fy_px", self.fy_px, 1e-3, 1e6)?;
        check_within("cx_px", self.cx_px, -1e6, 1e6)?;
        check_within("cy_px", self.cy_px, -1e6, 1e6)
    }
}

impl private::Sealed for Camera {}

impl Payload for Camera {
    const KIND: Kind = Kind::Camera;
    type Metadata = CameraMetadata;

    fn into_parts(self) -> (CameraMetadata, Body) {
        (self.metadata, Body::Bytes(self.image))
    }

    fn check(metadata: &CameraMetadata, limits: &Limits) -> Result<BodyShape, WireError> {
        check_within("width_px", metadata.width_px.into(), 1.0, MAX_EDGE_PX)?;
        check_within("height_px", metadata.height_px.into(), 1.0, MAX_EDGE_PX)?;
        let (pinhole, pose) = (&metadata.pinhole, &metadata.lidar_from_camera);
        pinhole.iter().try_for_each(Pinhole::check_values)?;
        pose.iter()
            .try_for_each(|pose| check_pose("lidar_from_camera", pose))?;
        let max = limits.max_body_bytes;
        Ok(BodyShape::Bytes { min: 1, max })
    }

    fn from_parts(metadata: CameraMetadata, body: Body) -> Result<Self, WireError> {
        match body {
            Body::Bytes(image) => Ok(Self { metadata, image }),
            body => Err(wrong_body(1, &body)),
        }
    }
}
