//! Scale of intensities of each source, normalised to 0 to 1.
//!
//! The red byte of a colour and a byte are divided by 255. The type of a wider number does not determine its scale; the
//! largest value of the agent's first sweeps does: up to 1 it stays as it is, up to 255 it is divided by 255, and
//! beyond that by the smallest 2^n - 1 that holds it, which `sim_replay::inspect` reports as a problem.

use std::fmt;
use std::str::FromStr;

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use crate::pcd::{IntensityKind, PcdCloud};

/// Largest number in a byte.
pub(super) const BYTE: f32 = 255.0;

/// Divisor of the intensities that a data set stores: [`Self::AUTO`], or a number parsed from text.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
#[serde(try_from = "String", into = "String")]
pub struct IntensityScale {
    /// A normal, positive number.
    divisor: Option<f32>,
}

// Never NaN.
impl Eq for IntensityScale {}

/// Reasons why a text is no [`IntensityScale`].
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error(
    "{0:?}, expected auto or a positive number that intensities are divided by, for example 1 or 255"
)]
pub struct IntensityScaleError(String);

impl FromStr for IntensityScale {
    type Err = IntensityScaleError;

    fn from_str(text: &str) -> Result<Self, Self::Err> {
        if text == "auto" {
            return Ok(Self::AUTO);
        }
        let divisor = text
            .parse()
            .ok()
            .filter(|divisor: &f32| divisor.is_normal() && *divisor > 0.0);
        divisor
            .map(|divisor| Self {
                divisor: Some(divisor),
            })
            .ok_or_else(|| IntensityScaleError(text.to_owned()))
    }
}

impl TryFrom<String> for IntensityScale {
    type Error = IntensityScaleError;

    fn try_from(text: String) -> Result<Self, Self::Error> {
        text.parse()
    }
}

impl From<IntensityScale> for String {
    fn from(scale: IntensityScale) -> Self {
        scale.to_string()
    }
}

impl fmt::Display for IntensityScale {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self.divisor {
            None => f.write_str("auto"),
            Some(divisor) => write!(f, "{divisor}"),
        }
    }
}

impl IntensityScale {
    /// By the type of the field, or by the range of the agent's first sweeps.
    pub const AUTO: Self = Self { divisor: None };

    /// Divides the stored values. `by_range` gives the divisor of numbers whose type does not determine their scale.
    pub(crate) fn apply(self, cloud: &mut PcdCloud, by_range: impl FnOnce() -> f32) {
        let Some(origin) = &mut cloud.intensity else {
            return;
        };
        origin.divisor = match (self.divisor, origin.kind) {
            (Some(divisor), _) => divisor,
            (None, IntensityKind::RedByte | IntensityKind::Byte) => BYTE,
            (None, IntensityKind::Number) => by_range(),
        };
        let divisor = origin.divisor;
        #[expect(clippy::float_cmp, reason = "a division by exactly 1 changes nothing")]
        if divisor != 1.0 {
            cloud
                .points
                .xyzi
                .iter_mut()
                .for_each(|point| point[3] /= divisor);
        }
    }
}

/// Divisor for numbers with the maximum `largest`.
pub(super) fn divisor_of_range(largest: f32) -> f32 {
    if largest <= 1.0 {
        return 1.0;
    }
    // 2^9 - 1 and so on have no more than 24 bits up to 2^24 - 1, and are rounded up from there.
    (8..=32)
        .map(|bits| ((1_u64 << bits) - 1) as f32)
        .find(|&limit| largest <= limit)
        .unwrap_or(u32::MAX as f32)
}

#[cfg(test)]
mod tests {
    use protocol::PointCloud;

    use super::*;
    use crate::pcd::IntensityOrigin;

    fn scaled(scale: IntensityScale, kind: IntensityKind, stored: f32) -> (f32, f32) {
        let intensity = Some(IntensityOrigin {
            field: "intensity".into(),
            kind,
            divisor: 1.0,
        });
        let points = PointCloud {
            xyzi: vec![[1.0, 2.0, 3.0, stored]],
        };
        let mut cloud = PcdCloud {
            points,
            intensity,
            ..PcdCloud::default()
        };
        scale.apply(&mut cloud, || divisor_of_range(stored));
        (cloud.points.xyzi[0][3], cloud.intensity.unwrap().divisor)
    }

    #[test]
    fn the_type_or_the_range_determines_the_scale() {
        let auto = |kind, stored| scaled(IntensityScale::AUTO, kind, stored);
        assert_eq!(auto(IntensityKind::RedByte, 194.0), (194.0 / 255.0, 255.0));
        assert_eq!(auto(IntensityKind::Byte, 1.0), (1.0 / 255.0, 255.0));
        assert_eq!(auto(IntensityKind::Number, 0.99), (0.99, 1.0));
        assert_eq!(auto(IntensityKind::Number, 1.0), (1.0, 1.0));
        assert_eq!(auto(IntensityKind::Number, 200.0), (200.0 / 255.0, 255.0));
        assert_eq!(auto(IntensityKind::Number, 256.0).1, 511.0);
        assert_eq!(auto(IntensityKind::Number, 40_000.0).1, 65_535.0);
        assert_eq!(auto(IntensityKind::Number, f32::MAX).1, u32::MAX as f32);
        assert_eq!(
            scaled("100".parse().unwrap(), IntensityKind::Byte, 50.0),
            (0.5, 100.0)
        );
    }

    #[test]
    fn the_option_is_auto_or_a_positive_number() {
        assert_eq!("auto".parse(), Ok(IntensityScale::AUTO));
        assert_eq!("255".parse::<IntensityScale>().unwrap().to_string(), "255");
        for wrong in ["", "0", "-1", "nan", "inf", "byte"] {
            let error = wrong.parse::<IntensityScale>().unwrap_err().to_string();
            assert!(
                error.starts_with(&format!("{wrong:?}, expected auto or a positive number")),
                "{error}"
            );
        }
    }
}
