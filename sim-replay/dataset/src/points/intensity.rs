//! Scale of intensities of each source, normalised to 0 to 1.
//!
//! The red byte of a colour and a byte are divided by 255. The type of a wider number does not determine its scale; the
//! 99 % quantile of the agent's first sweeps does ([`upper_intensity`]): up to 1 it stays as it is, up to 255 it is
//! divided by 255, and beyond that by the smallest 2^n - 1 that holds it, which `sim_replay::inspect` reports as a
//! problem.

use std::fmt;
use std::str::FromStr;

use protocol::{PointCloud, intensity_divisor};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use crate::pcd::{IntensityKind, PcdCloud};

/// Largest number in a byte.
const BYTE: f32 = 255.0;
/// Number of sweeps of a LiDAR whose range determines the scale.
pub(super) const SAMPLES: usize = 3;
/// One of this many points may be above the range of its sweep: a reflector, or a fault.
const POINTS_PER_OUTLIER: usize = 100;
/// Of at least this many points, one has at least this intensity: sensors measure lane markings and number plates.
const ENOUGH_POINTS: usize = 500;
const LEAST_LARGEST: f32 = 0.02;
/// Finding about sweeps without intensities.
pub(crate) const NO_INTENSITY: &str =
    "no intensity field (intensity, reflectivity, remission, rgb, ...): it is 0 for all points";

/// Divisor of the intensities that a data set stores: `auto`, or a number parsed from text.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
#[serde(try_from = "String", into = "String")]
pub struct IntensityScale {
    /// A normal, positive number.
    divisor: Option<f32>,
}

// Never NaN.
impl Eq for IntensityScale {}

/// Option of commands that read sweeps of a data set.
#[derive(Debug, Clone, Copy, Default, clap::Args)]
pub struct IntensityOption {
    /// Number that stored intensities are divided by [default: auto; `sim-replay inspect --help` describes the rule].
    #[arg(id = "intensity_scale", long = "intensity-scale")]
    #[arg(value_name = "auto|1|255|NUMBER", default_value_t)]
    #[arg(hide_default_value = true)]
    pub scale: IntensityScale,
}

impl FromStr for IntensityScale {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        if text == "auto" {
            return Ok(Self::AUTO);
        }
        let divisor = text.parse().ok();
        // Neither 0 nor NaN, infinite or subnormal: intensities stay finite.
        match divisor.filter(|divisor: &f32| divisor.is_normal() && *divisor > 0.0) {
            None => Err(format!(
                "{text:?}, expected auto or a positive number that intensities are divided by, for example 1 or 255"
            )),
            divisor => Ok(Self { divisor }),
        }
    }
}

protocol::written_as_text!(IntensityScale);

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
        origin.divisor = self.divisor(origin.kind, by_range);
        divide(&mut cloud.points, origin.divisor);
    }

    fn divisor(self, kind: IntensityKind, by_range: impl FnOnce() -> f32) -> f32 {
        match (self.divisor, kind) {
            (Some(divisor), _) => divisor,
            (None, IntensityKind::RedByte | IntensityKind::Byte) => BYTE,
            (None, IntensityKind::Number) => by_range(),
        }
    }

    /// The finding that no usual scale fits intensities that were divided by `divisor`.
    pub(crate) fn unusual(self, divisor: f32, upper_stored: f32) -> Option<String> {
        (self == Self::AUTO && ![1.0, BYTE].contains(&divisor)).then(|| {
            format!(
                "intensities reach {upper_stored}, neither 0 to 1 nor 0 to 255: divided by {divisor} unless their \
                 scale is stated"
            )
        })
    }
}

/// The finding that the largest intensity of a number of points is too small but not 0; `from` states field and
/// divisor.
pub(crate) fn faint(points: usize, largest: f32, from: &str) -> Option<String> {
    (points >= ENOUGH_POINTS && 0.0 < largest && largest < LEAST_LARGEST).then(|| {
        format!(
            "the largest of {points} intensities is {largest:.2e} ({from}), expected {LEAST_LARGEST} to 1: see \
             --intensity-scale"
        )
    })
}

/// Upper end of the range of a sweep's intensities: their 99 % quantile, the largest of less than 100 points; 0 without
/// points.
pub(super) fn upper_intensity(points: &PointCloud) -> f32 {
    let mut values: Vec<f32> = points.xyzi.iter().map(|point| point[3]).collect();
    let outliers = values.len() / POINTS_PER_OUTLIER;
    let Some(rank) = values.len().checked_sub(outliers + 1) else {
        return 0.0;
    };
    let (_, upper, _) = values.select_nth_unstable_by(rank, f32::total_cmp);
    upper.max(0.0)
}

fn divide(points: &mut PointCloud, divisor: f32) {
    #[expect(clippy::float_cmp, reason = "a division by exactly 1 changes nothing")]
    if divisor != 1.0 {
        points.xyzi.iter_mut().for_each(|point| point[3] /= divisor);
    }
}

/// Scale of the intensities of one live LiDAR: by type or by the range of its first sweeps, as for files.
#[derive(Debug, Default)]
pub struct LiveIntensities {
    scale: IntensityScale,
    /// Number of sweeps that determined the range.
    samples: usize,
    /// The largest [`upper_intensity`] of these.
    upper: f32,
    has_finding: bool,
}

impl LiveIntensities {
    /// A LiDAR before its first sweep.
    pub fn new(scale: IntensityScale) -> Self {
        Self {
            scale,
            ..Self::default()
        }
    }

    /// Scales the intensities of the next sweep to 0..1; `field` has their name and type. Returns the first finding: no
    /// field, an unusual range, or intensities above 1 or far below it.
    pub fn scale(
        &mut self,
        points: &mut PointCloud,
        field: Option<(String, IntensityKind)>,
    ) -> Option<String> {
        // As stored: taken before the division below.
        let largest = points
            .xyzi
            .iter()
            .fold(0.0, |largest: f32, point| largest.max(point[3]));
        let finding = match field {
            None => Some(NO_INTENSITY.to_owned()),
            Some((name, kind)) => {
                // The range is fixed after some sweeps: a later change would shift all intensities.
                if self.samples < SAMPLES && !points.is_empty() {
                    self.samples += 1;
                    self.upper = self.upper.max(upper_intensity(points));
                }
                let divisor = self.scale.divisor(kind, || intensity_divisor(self.upper));
                divide(points, divisor);
                (self.scale.unusual(divisor, self.upper))
                    .or_else(|| (largest > divisor).then(|| {
                    format!(
                        "field {name} reaches {largest}, {} divided by {divisor}: networks are trained on 0 to 1",
                        largest / divisor
                    )
                }))
                .or_else(|| {
                    let from = format!("field {name} divided by {divisor}");
                    faint(points.len(), largest / divisor, &from)
                })
            }
        };
        // Filtered last: only a finding sets the flag.
        finding.filter(|_| !std::mem::replace(&mut self.has_finding, true))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::pcd::IntensityOrigin;

    fn one_point(intensity: f32) -> PointCloud {
        PointCloud {
            xyzi: vec![[1.0, 2.0, 3.0, intensity]],
        }
    }

    fn scaled(scale: IntensityScale, kind: IntensityKind, stored: f32) -> (f32, f32) {
        let intensity = Some(IntensityOrigin {
            field: "intensity".into(),
            kind,
            divisor: 1.0,
        });
        let mut cloud = PcdCloud {
            points: one_point(stored),
            intensity,
            ..PcdCloud::default()
        };
        scale.apply(&mut cloud, || intensity_divisor(stored));
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
    fn live_sweeps_have_the_scale_of_files_and_findings_are_reported_once() {
        let number = Some(("i".to_owned(), IntensityKind::Number));
        let mut live = LiveIntensities::new(IntensityScale::AUTO);
        for (intensity, field, expected) in [
            (255.0, number.clone(), (1.0, None)),
            (51.0, number.clone(), (0.2, None)),
            (0.0, None, (0.0, Some(NO_INTENSITY.to_owned()))),
            (0.0, None, (0.0, None)),
        ] {
            let mut points = one_point(intensity);
            let finding = live.scale(&mut points, field);
            assert_eq!((points.xyzi[0][3], finding), expected, "{intensity}");
        }
        let mut stated = LiveIntensities::new("100".parse().unwrap());
        let mut points = one_point(150.0);
        let finding = stated.scale(&mut points, number.clone()).unwrap();
        assert!(
            finding.starts_with("field i reaches 150, 1.5 divided by 100"),
            "{finding}"
        );
        let mut unusual = LiveIntensities::new(IntensityScale::AUTO);
        let finding = unusual.scale(&mut one_point(4000.0), number).unwrap();
        assert!(
            finding.contains("neither 0 to 1 nor 0 to 255: divided by 4095"),
            "{finding}"
        );
        let byte = Some(("intensity".to_owned(), IntensityKind::Byte));
        let mut live = LiveIntensities::new(IntensityScale::AUTO);
        let mut points = one_point(1.0);
        assert_eq!(live.scale(&mut points, byte), None);
        assert_eq!(points.xyzi[0][3], 1.0 / 255.0);
    }

    #[test]
    fn single_bright_points_do_not_decide_the_scale_of_live_sweeps() {
        let number = Some(("i".to_owned(), IntensityKind::Number));
        for (bright, expected) in [(1, 0.5), (2, 0.5 / 255.0)] {
            let mut points = PointCloud {
                xyzi: vec![[1.0, 2.0, 3.0, 0.5]; 100],
            };
            points.xyzi[..bright].fill([1.0, 2.0, 3.0, 1.02]);
            let mut live = LiveIntensities::new(IntensityScale::AUTO);
            let finding = live.scale(&mut points, number.clone());
            assert_eq!(points.xyzi[99][3], expected, "{bright} of 100");
            assert_eq!(finding.is_some(), bright == 1, "above 1: {finding:?}");
        }
    }

    #[test]
    fn live_intensities_far_below_one_are_named() {
        let number = Some(("i".to_owned(), IntensityKind::Number));
        for (count, stored, is_named) in [(500, 0.9, true), (499, 0.9, false), (500, 6.0, false)] {
            let mut points = PointCloud {
                xyzi: vec![[1.0, 2.0, 3.0, stored]; count],
            };
            let mut live = LiveIntensities::new("255".parse().unwrap());
            let finding = live.scale(&mut points, number.clone());
            assert_eq!(finding.is_some(), is_named, "{finding:?}");
            let is_scale =
                |text: String| text.contains("is 3.53e-3 (field i divided by 255), expected 0.02");
            assert!(finding.is_none_or(is_scale));
        }
    }

    #[test]
    fn the_option_is_auto_or_a_positive_number() {
        assert_eq!("auto".parse(), Ok(IntensityScale::AUTO));
        assert_eq!("255".parse::<IntensityScale>().unwrap().to_string(), "255");
        for wrong in ["", "0", "-1", "nan", "inf", "byte"] {
            let error = wrong.parse::<IntensityScale>().unwrap_err();
            assert!(
                error.starts_with(&format!("{wrong:?}, expected auto or a positive number")),
                "{error}"
            );
        }
    }
}
