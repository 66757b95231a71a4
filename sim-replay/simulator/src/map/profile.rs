//! Values along a road in OpenDRIVE's form: piecewise cubics.

use super::curve::{cubic, cubic_slope};

/// A value along a road: cubics, each from its start on.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Profile {
    /// Start `s` and coefficients a, b, c, d of each cubic, by rising `s`.
    pub records: Vec<(f64, [f64; 4])>,
}

impl Profile {
    /// The same value everywhere.
    pub fn constant(value: f64) -> Self {
        let records = vec![(0.0, [value, 0.0, 0.0, 0.0])];
        Self { records }
    }

    /// The cubic that leads from one value and slope to another over `length` from `start` on.
    pub(crate) fn hermite(
        start: f64,
        length: f64,
        [from, slope]: [f64; 2],
        [to, end_slope]: [f64; 2],
    ) -> (f64, [f64; 4]) {
        let rise = (to - from) / length;
        let c = (3.0 * rise - 2.0 * slope - end_slope) / length;
        let d = (slope + end_slope - 2.0 * rise) / (length * length);
        (start, [from, slope, c, d])
    }

    /// That cubic alone, from 0 on.
    pub(crate) fn between(length: f64, from: [f64; 2], to: [f64; 2]) -> Self {
        let records = vec![Self::hermite(0.0, length, from, to)];
        Self { records }
    }

    /// Value at `s`; the first cubic also holds before its start, and an empty profile is 0.
    pub fn at(&self, s: f64) -> f64 {
        self.record_at(s)
            .map_or(0.0, |(start, coefficients)| cubic(coefficients, s - start))
    }

    /// Slope at `s`.
    pub(crate) fn slope_at(&self, s: f64) -> f64 {
        self.record_at(s).map_or(0.0, |(start, coefficients)| {
            cubic_slope(coefficients, s - start)
        })
    }

    /// Values at `count` + 1 even places from 0 to `length_m`.
    pub(crate) fn samples(&self, length_m: f64, count: u32) -> impl Iterator<Item = f64> {
        (0..=count).map(move |place| self.at(length_m * f64::from(place) / f64::from(count)))
    }

    pub(crate) fn record_at(&self, s: f64) -> Option<(f64, [f64; 4])> {
        let after = self.records.partition_point(|&(start, _)| start <= s);
        self.records.get(after.saturating_sub(1)).copied()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn profile_switches_cubics_and_hermite_meets_both_ends() {
        let ramp = Profile::hermite(10.0, 20.0, [1.0, 0.0], [5.0, 0.1]);
        let profile = Profile {
            records: vec![
                (0.0, [1.0, 0.0, 0.0, 0.0]),
                ramp,
                (30.0, [5.0, 0.1, 0.0, 0.0]),
            ],
        };
        assert!((profile.at(-3.0) - 1.0).abs() < 1e-12);
        assert!((profile.at(30.0 - 1e-9) - profile.at(30.0)).abs() < 1e-6);
        assert!((profile.slope_at(30.0 - 1e-9) - 0.1).abs() < 1e-6);
        assert!((profile.at(40.0) - 6.0).abs() < 1e-12);
        assert_eq!(Profile::default().at(3.0), 0.0);
    }
}
