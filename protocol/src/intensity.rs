//! Intensity of LiDAR points: names of its field, types of the stored number, and the range that gives its scale.

use serde::Serialize;

/// Names of the field of an intensity, the preferred first, compared without case.
pub const INTENSITY_FIELDS: [&str; 8] = [
    "intensity",
    "i",
    "scalar_intensity",
    "reflectivity",
    "scalar_reflectivity",
    "reflectance",
    "remission",
    "signal",
];

/// Names of packed colours `0x00RRGGBB`, whose red byte is an intensity where there is no other.
pub const COLOUR_FIELDS: [&str; 2] = ["rgb", "rgba"];

/// Type of number that stores an intensity.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum IntensityKind {
    /// The red byte of a packed colour, 0..255.
    RedByte,
    /// A byte, 0..255.
    Byte,
    /// A wider number, whose type does not determine its scale.
    Number,
}

/// Divisor that brings intensities of up to `upper`, the upper end of their range, to 0..1: 1 for 1 and less, else the
/// smallest 2^n - 1 from 255 on that is not less.
pub fn intensity_divisor(upper: f32) -> f32 {
    if upper <= 1.0 {
        return 1.0;
    }
    // 2^9 - 1 and so on have no more than 24 bits up to 2^24 - 1, and are rounded up from there.
    (8..=32)
        .map(|bits| ((1_u64 << bits) - 1) as f32)
        .find(|&limit| upper <= limit)
        .unwrap_or(u32::MAX as f32)
}
