//! Scale of an axis: equal differences or equal ratios, as one type for plotters.

use std::ops::Range;

use plotters::coord::ranged1d::{KeyPointHint, NoDefaultFormatting, Ranged, ValueFormatter};
use plotters::coord::types::RangedCoordf64;
use plotters::prelude::{IntoLogRange, LogCoord};

pub(super) enum AxisScale {
    Linear(RangedCoordf64),
    Logarithmic(LogCoord<f64>),
}

impl AxisScale {
    pub(super) fn new([low, high]: [f64; 2], is_logarithmic: bool) -> Self {
        match is_logarithmic {
            true => Self::Logarithmic((low..high).log_scale().into()),
            false => Self::Linear((low..high).into()),
        }
    }
}

impl Ranged for AxisScale {
    type FormatOption = NoDefaultFormatting;
    type ValueType = f64;

    fn map(&self, value: &f64, limit: (i32, i32)) -> i32 {
        match self {
            Self::Linear(scale) => scale.map(value, limit),
            Self::Logarithmic(scale) => scale.map(value, limit),
        }
    }

    fn key_points<Hint: KeyPointHint>(&self, hint: Hint) -> Vec<f64> {
        match self {
            Self::Linear(scale) => scale.key_points(hint),
            Self::Logarithmic(scale) => {
                decades(&scale.range()).unwrap_or_else(|| scale.key_points(hint))
            }
        }
    }

    fn range(&self) -> Range<f64> {
        match self {
            Self::Linear(scale) => scale.range(),
            Self::Logarithmic(scale) => scale.range(),
        }
    }
}

/// Powers of ten of a range, its ends included; `None` where there are fewer than two.
fn decades(range: &Range<f64>) -> Option<Vec<f64>> {
    // Logarithms of powers of ten are not exact.
    let first = (range.start.log10() - 1e-9).ceil() as i32;
    let last = (range.end.log10() + 1e-9).floor() as i32;
    let powers = (first..=last).map(|power| 10f64.powi(power));
    (last > first).then(|| powers.collect())
}

impl ValueFormatter<f64> for AxisScale {
    /// Shortest readable form.
    fn format(value: &f64) -> String {
        format!("{}", (value * 1000.0).round() / 1000.0)
    }
}
