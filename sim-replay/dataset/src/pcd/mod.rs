//! PCD point files: ASCII, binary and LZF-compressed, as PCL, Open3D and the OPV2V family write them.
//!
//! Intensity comes from the field `intensity`, else from the red byte of `rgb`: OPV2V stores R / 255 there, in a word
//! `0x00RRGGBB` whose bits are printed as a float. Every red below 128 is a subnormal number then, so the text is
//! parsed exactly and only the bits are used.
//!
//! Points stay in the frame and handedness of the file; mirroring is done by the readers of data sets.
//!
//! ```
//! use protocol::PointCloud;
//! use dataset::pcd::{self, Encoding, IntensityField};
//!
//! let cloud = PointCloud { xyzi: vec![[1.0, 2.0, 3.0, 0.5]] };
//! let bytes = pcd::encode(&cloud, Encoding::Binary, IntensityField::Intensity);
//! assert_eq!(pcd::decode(&bytes).unwrap().points, cloud);
//! ```

mod ascii;
mod binary;
mod encode;
mod header;
mod lzf;
mod number;

use protocol::PointCloud;
use serde::Serialize;

pub use encode::{Encoding, IntensityField, encode};

use crate::error::shown;
use header::{Data, PcdHeader};
pub use protocol::IntensityKind;

/// Largest point file that is read, bytes, compressed or not: a sweep of a 128-channel LiDAR has some 10 MB.
pub(super) const MAX_BYTES: u64 = 1 << 30;
/// Red of full intensity.
const RED_SCALE: f32 = 255.0;

/// Content of a PCD file.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct PcdCloud {
    /// The points whose coordinates and intensity are finite, in the order of the file.
    pub points: PointCloud,
    /// The green byte of `rgb` for each of `points`, if any is not zero: V2X-R labels weather clutter with it.
    pub labels: Option<Vec<u8>>,
    /// Number of points left out because a number is NaN or infinite.
    pub dropped: usize,
    /// Position of the first of these.
    pub first_dropped: Option<PcdPlace>,
    /// Source of the intensities; `None` if the file has none, and all are 0.
    pub intensity: Option<IntensityOrigin>,
    /// Form of the file, for example `PCD` or `5 floats per point: x y z intensity ring`; empty if it is unknown.
    pub form: &'static str,
}

/// Source of the intensities of a sweep.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct IntensityOrigin {
    /// Name of the field.
    pub field: String,
    /// Type of the stored number, which may determine its scale.
    pub kind: IntensityKind,
    /// Divisor from the stored numbers to the values of [`PcdCloud::points`].
    pub divisor: f32,
}

/// Position in a file.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum PcdPlace {
    /// A line, from 1.
    Line(u64),
    /// A point, from 0.
    Point(u64),
}

/// Reasons why bytes are not a readable PCD file.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("{}{}{reason}", shown("line ", *line, ": "), shown("", field.as_ref(), ": "))]
pub struct PcdError {
    /// The line at fault, from 1, if the fault is in text.
    pub line: Option<u64>,
    /// The header key or the field of a point.
    pub field: Option<String>,
    /// Found and expected value.
    pub reason: String,
}

impl PcdError {
    fn at(line: u64, field: impl Into<String>, reason: impl Into<String>) -> Self {
        Self {
            line: Some(line),
            ..Self::of(field, reason)
        }
    }

    fn of(field: impl Into<String>, reason: impl Into<String>) -> Self {
        Self {
            line: None,
            field: Some(field.into()),
            reason: reason.into(),
        }
    }
}

/// Reads a PCD file in memory. Intensities are as the file stores them; the red byte of a colour is 0 to 1.
///
/// # Errors
/// [`PcdError`] with line, field and both values of the fault. No allocation relies on the header alone.
pub fn decode(bytes: &[u8]) -> Result<PcdCloud, PcdError> {
    let mut cloud = decode_stored(bytes)?;
    if let Some(origin) = &mut cloud.intensity
        && origin.kind == IntensityKind::RedByte
    {
        origin.divisor = RED_SCALE;
        for point in &mut cloud.points.xyzi {
            point[3] /= RED_SCALE;
        }
    }
    Ok(cloud)
}

/// [`decode`] with the red byte of a colour as stored: 0 to 255.
pub(crate) fn decode_stored(bytes: &[u8]) -> Result<PcdCloud, PcdError> {
    let (header, body) = PcdHeader::parse(bytes)?;
    let (cloud, form) = match header.data {
        Data::Ascii => (ascii::decode(&header, body)?, "PCD, ascii"),
        Data::Binary => (binary::decode(&header, body)?, "PCD, binary"),
        Data::BinaryCompressed => (binary::decode_compressed(&header, body)?, "PCD, compressed"),
    };
    let intensity = header
        .intensity_origin()
        .map(|(field, kind)| IntensityOrigin::stored(field, kind));
    Ok(PcdCloud {
        intensity,
        form,
        ..cloud
    })
}

impl IntensityOrigin {
    /// A field whose numbers are used as stored.
    pub(crate) fn stored(field: &str, kind: IntensityKind) -> Self {
        Self {
            field: field.to_owned(),
            kind,
            divisor: 1.0,
        }
    }
}

impl PcdCloud {
    /// The cloud of finite points that a file of this form holds.
    pub(crate) fn of_points(
        points: Vec<[f32; 4]>,
        intensity: Option<IntensityOrigin>,
        form: &'static str,
    ) -> Self {
        Self {
            intensity,
            form,
            ..Self::of_finite(points, Vec::new())
        }
    }

    /// Removes points that are not finite. `labels`: one for each point, or none.
    pub(crate) fn of_finite(mut points: Vec<[f32; 4]>, mut labels: Vec<u8>) -> Self {
        let all = points.len();
        let first = points.iter().position(|point| !is_finite(point));
        if first.is_some() {
            // Labels first, while the points still show which of them stay.
            let mut kept = points.iter().map(is_finite);
            labels.retain(|_| kept.next().unwrap_or(false));
            points.retain(is_finite);
        }
        Self {
            dropped: all - points.len(),
            first_dropped: first.map(|point| PcdPlace::Point(point as u64)),
            points: PointCloud { xyzi: points },
            labels: labels.iter().any(|&label| label != 0).then_some(labels),
            ..Self::default()
        }
    }
}

fn is_finite(point: &[f32; 4]) -> bool {
    point.iter().all(|value| value.is_finite())
}

/// Red and green of a packed `0x00RRGGBB`: intensity and label.
fn unpack_rgb(bits: u32) -> (f32, u8) {
    let [_, red, green, _] = bits.to_be_bytes();
    (f32::from(red), green)
}

#[cfg(test)]
mod tests;
