//! Cross-sections of roads that are not level: superelevation, crossfall and shape.
//!
//! In a cross-section, `t` and `h` turn with the superelevation about the reference line: a place at `t` on a road with
//! superelevation alone lies `t cos` beside the line and `t sin` above it. Crossfall and shape give `h` over `t`.

use super::profile::Profile;

/// Steepest superelevation and crossfall, radians; steeper ones are no road.
pub(super) const MAX_SLOPE_RAD: f64 = 1.4;
/// Highest place of a shape over the reference line, metres.
pub(super) const MAX_SHAPE_M: f64 = 100.0;

/// Shape of the surface of a road across it; level where all is empty.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct LateralProfile {
    /// Turn about the reference line, radians; positive lifts the left side.
    pub superelevation_rad: Profile,
    /// Fall from the reference line outwards, on the left and on the right side, radians; positive falls.
    pub crossfall_rad: [Profile; 2],
    /// Cross-sections, by rising `s`; between two of them heights change evenly.
    pub shapes: Vec<CrossShape>,
}

/// Heights across a road at one place along it.
#[derive(Debug, Clone, PartialEq)]
pub struct CrossShape {
    /// Place along the road, metres.
    pub s_m: f64,
    /// Height over `t`, metres.
    pub height_m: Profile,
}

impl LateralProfile {
    /// True if the road is level everywhere.
    pub fn is_level(&self) -> bool {
        self.superelevation_rad.records.is_empty() && self.is_flat()
    }

    /// True if every cross-section is a straight line, level or not.
    pub fn is_flat(&self) -> bool {
        let mut sides = self.crossfall_rad.iter();
        sides.all(|side| side.records.is_empty()) && self.shapes.is_empty()
    }

    /// Distance beside the reference line (positive to the left) and height over it of the surface at `s_m`, `t_m`,
    /// metres.
    pub fn at(&self, s_m: f64, t_m: f64) -> [f64; 2] {
        let crossfall_rad = &self.crossfall_rad[usize::from(t_m < 0.0)];
        let [fall, turn] = [crossfall_rad, &self.superelevation_rad]
            .map(|slope_rad| slope_rad.at(s_m).clamp(-MAX_SLOPE_RAD, MAX_SLOPE_RAD));
        let height = self.shape_m(s_m, t_m) - t_m.abs() * fall.tan();
        let (sin, cos) = turn.sin_cos();
        [t_m * cos - height * sin, t_m * sin + height * cos]
    }

    fn shape_m(&self, s_m: f64, t_m: f64) -> f64 {
        let after = self.shapes.partition_point(|shape| shape.s_m <= s_m);
        let before = self.shapes.get(after.saturating_sub(1));
        match (before, self.shapes.get(after)) {
            (Some(before), Some(next)) if next.s_m > before.s_m => {
                let share = ((s_m - before.s_m) / (next.s_m - before.s_m)).clamp(0.0, 1.0);
                (1.0 - share) * before.at(t_m) + share * next.at(t_m)
            }
            (Some(shape), _) | (None, Some(shape)) => shape.at(t_m),
            (None, None) => 0.0,
        }
    }
}

impl CrossShape {
    /// Height at `t_m`; before the first record as at its start.
    fn at(&self, t_m: f64) -> f64 {
        let first = self.height_m.records.first();
        let first_m = first.map_or(t_m, |&(start, _)| start);
        let height_m = self.height_m.at(t_m.max(first_m));
        height_m.clamp(-MAX_SHAPE_M, MAX_SHAPE_M)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn superelevation_turns_the_section_about_the_reference_line() {
        let lateral = LateralProfile {
            superelevation_rad: Profile::constant(0.1),
            ..LateralProfile::default()
        };
        for t in [-6.0, -1.5, 4.0] {
            let [aside, height] = lateral.at(3.0, t);
            assert!(
                (aside - t * 0.1f64.cos()).abs() < 1e-12
                    && (height - t * 0.1f64.sin()).abs() < 1e-12
            );
        }
        assert!(lateral.is_flat() && !lateral.is_level() && LateralProfile::default().is_level());
    }

    #[test]
    fn crossfall_falls_on_both_sides_of_the_line() {
        let crossfall_rad = [Profile::constant(0.02), Profile::constant(0.04)];
        let lateral = LateralProfile {
            crossfall_rad,
            ..LateralProfile::default()
        };
        assert!((lateral.at(0.0, 5.0)[1] + 5.0 * 0.02f64.tan()).abs() < 1e-12);
        assert!((lateral.at(0.0, -5.0)[1] + 5.0 * 0.04f64.tan()).abs() < 1e-12);
        assert_eq!(lateral.at(0.0, 0.0), [0.0, 0.0]);
    }

    #[test]
    fn shapes_change_evenly_from_one_cross_section_to_the_next() {
        // Roofs with their ridge over the reference line.
        let roofs = [(0.0, 0.4), (100.0, 0.8)].map(|(s_m, ridge_m)| {
            let records = vec![
                (-4.0, [0.0, ridge_m / 4.0, 0.0, 0.0]),
                (0.0, [ridge_m, -ridge_m / 4.0, 0.0, 0.0]),
            ];
            let height_m = Profile { records };
            CrossShape { s_m, height_m }
        });
        let lateral = LateralProfile {
            shapes: roofs.into(),
            ..LateralProfile::default()
        };
        for (s, t, expected) in [
            (0.0, 0.0, 0.4),
            (50.0, 0.0, 0.6),
            (100.0, 2.0, 0.4),
            (150.0, 0.0, 0.8),
            (0.0, -9.0, 0.0),
        ] {
            assert!((lateral.at(s, t)[1] - expected).abs() < 1e-12, "{s} {t}");
        }
    }
}
