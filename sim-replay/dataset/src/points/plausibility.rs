//! Plausibility of a sweep: limits that real sweeps keep and wrongly decoded ones exceed.

use protocol::PointCloud;

use crate::pcd::PcdCloud;

/// Range within which nearly all points lie, metres.
const RANGE_M: f32 = 300.0;
/// Least share of the points within that range.
const WITHIN_RANGE: f64 = 0.95;
/// Largest share of the points exactly at the origin; sensors write rays without a hit so.
const AT_ORIGIN: f64 = 0.5;
/// Magnitude below which only zero itself is a coordinate: integers read as floats lie there.
pub(super) const TINY: f32 = 1e-30;
/// Largest share of coordinates that are tiny.
const TINY_SHARE: f64 = 0.01;

/// Counts over the points of some sweeps.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Plausibility {
    points: usize,
    beyond_range: usize,
    at_origin: usize,
    tiny: usize,
}

impl Plausibility {
    /// Counts of one sweep, whose points are finite.
    pub fn of(cloud: &PointCloud) -> Self {
        let mut counted = Self {
            points: cloud.len(),
            ..Self::default()
        };
        for &[x, y, z, _] in &cloud.xyzi {
            // Infinite where the square is too large for a float.
            counted.beyond_range += usize::from(x * x + y * y + z * z > RANGE_M * RANGE_M);
            counted.at_origin += usize::from([x, y, z] == [0.0; 3]);
            counted.tiny += [x, y, z]
                .into_iter()
                .filter(|&value| value != 0.0 && value.abs() < TINY)
                .count();
        }
        counted
    }

    /// The fault that no point is a return of a sensor: there is none, or all are too far away or at the origin.
    pub fn nothing_in_range(&self) -> Option<String> {
        let points = self.points;
        // No point is both: the origin is within the range.
        (points == self.beyond_range + self.at_origin).then(|| match points {
            0 => "the sweep has no point".to_owned(),
            _ => format!("none of the {points} points is a return within {RANGE_M} m"),
        })
    }

    /// Adds the counts of another sweep.
    pub fn join(&mut self, other: &Self) {
        self.points += other.points;
        self.beyond_range += other.beyond_range;
        self.at_origin += other.at_origin;
        self.tiny += other.tiny;
    }

    /// The first exceeded limit, and the usual value.
    pub fn fault(&self) -> Option<String> {
        // First: integers read as floats also lie within the range, close to the origin.
        let tiny = share(self.tiny, 3 * self.points);
        if tiny > TINY_SHARE {
            return Some(format!(
                "{:.1} % of the coordinates are tiny (below {TINY:e} m, not zero), usual is none: are these floats?",
                100.0 * tiny
            ));
        }
        let within = 1.0 - share(self.beyond_range, self.points);
        if within < WITHIN_RANGE {
            return Some(format!(
                "{:.1} % of the points lie within {RANGE_M} m, usual are {:.1} % or more",
                100.0 * within,
                100.0 * WITHIN_RANGE
            ));
        }
        let at_origin = share(self.at_origin, self.points);
        (at_origin > AT_ORIGIN).then(|| {
            format!(
                "{:.1} % of the points lie exactly at the origin, usual is none",
                100.0 * at_origin
            )
        })
    }
}

fn share(count: usize, all: usize) -> f64 {
    count as f64 / all.max(1) as f64
}

impl PcdCloud {
    /// The fault that no point of a sweep is a return, with the number of points that are not finite.
    pub fn without_returns(&self) -> Option<String> {
        let fault = Plausibility::of(&self.points).nothing_in_range()?;
        Some(match self.dropped {
            0 => fault,
            dropped => format!("{fault}, and {dropped} points are not finite"),
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn plausibility(points: &[[f32; 4]]) -> Plausibility {
        Plausibility::of(&PointCloud {
            xyzi: points.to_vec(),
        })
    }

    fn fault(points: &[[f32; 4]]) -> Option<String> {
        plausibility(points).fault()
    }

    #[test]
    fn one_return_in_range_is_a_sweep_and_none_is_not() {
        let (far, origin) = ([450_000.0, 5_400_000.0, 110.0, 0.5], [0.0; 4]);
        let cases: [(&[[f32; 4]], Option<&str>); 3] = [
            (&[far, origin, [9.0, 0.0, 0.0, 0.5]], None),
            (
                &[far, origin],
                Some("none of the 2 points is a return within 300 m"),
            ),
            (&[], Some("the sweep has no point")),
        ];
        for (points, expected) in cases {
            let fault = plausibility(points).nothing_in_range();
            assert_eq!(fault.as_deref(), expected);
        }
    }

    #[test]
    fn the_figure_and_the_usual_one_are_named() {
        let sound: Vec<[f32; 4]> = (0..100).map(|i| [i as f32, -3.0, 0.0, 0.5]).collect();
        assert_eq!(fault(&sound), None);
        assert_eq!(fault(&[]), None);
        let mut far = sound.clone();
        far[..6].fill([0.0, 301.0, 0.0, 0.5]);
        assert_eq!(
            fault(&far).unwrap(),
            "94.0 % of the points lie within 300 m, usual are 95.0 % or more"
        );
        let mut origin = sound.clone();
        origin[..51].fill([0.0, 0.0, 0.0, 0.5]);
        assert_eq!(
            fault(&origin).unwrap(),
            "51.0 % of the points lie exactly at the origin, usual is none"
        );
        let mut tiny = sound;
        tiny[..6].fill([f32::from_bits(7), 1.0, 1.0, 0.5]);
        assert!(
            fault(&tiny)
                .unwrap()
                .starts_with("2.0 % of the coordinates are tiny (below 1e-30 m, not zero)")
        );
    }
}
