//! Reference lines of roads: lines, arcs, spirals and polynomials, one after another.

use super::lane::wrap_angle;

/// Nodes and weights of 5-point Gauss-Legendre quadrature on [-1, 1].
const GAUSS: [(f64, f64); 5] = [
    (-0.906_179_845_938_664, 0.236_926_885_056_189_08),
    (-0.538_469_310_105_683_1, 0.478_628_670_499_366_47),
    (0.0, 0.568_888_888_888_888_9),
    (0.538_469_310_105_683_1, 0.478_628_670_499_366_47),
    (0.906_179_845_938_664, 0.236_926_885_056_189_08),
];
/// Angle within which the quadrature is exact to 1e-12 of the length, radians.
const GAUSS_ANGLE_RAD: f64 = 0.25;

/// A place and heading in the plane.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Pose2 {
    /// World x, metres.
    pub x: f64,
    /// World y, metres.
    pub y: f64,
    /// Heading, radians.
    pub heading_rad: f64,
}

/// Shape of one element of a reference line, in the frame of its start.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum CurveShape {
    /// Straight.
    Line,
    /// Circle; curvature in 1/m, positive to the left.
    Arc {
        /// Curvature, 1/m.
        curvature: f64,
    },
    /// Clothoid: curvature changes evenly along it.
    Spiral {
        /// Curvature at its start, 1/m.
        start: f64,
        /// Curvature at its end, 1/m.
        end: f64,
    },
    /// `v(u) = a + b u + c u^2 + d u^3`, with u along the start heading.
    Poly3([f64; 4]),
    /// u and v as cubics of a parameter.
    ParamPoly3 {
        /// Coefficients of u.
        u: [f64; 4],
        /// Coefficients of v.
        v: [f64; 4],
        /// True if the parameter runs over 0 to 1 instead of 0 to the length.
        normalized: bool,
    },
}

/// One element of a reference line.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PlanCurve {
    /// Distance of its start along the road, metres.
    pub s_m: f64,
    /// Place and heading of its start.
    pub start: Pose2,
    /// Length, metres.
    pub length_m: f64,
    /// Its shape.
    pub shape: CurveShape,
}

impl Pose2 {
    /// A pose from its coordinates.
    pub fn new(x: f64, y: f64, heading_rad: f64) -> Self {
        Self { x, y, heading_rad }
    }

    /// The pose that lies `u` ahead, `v` to the left and turned by `turn_rad`, seen from this one.
    pub fn moved(&self, u: f64, v: f64, turn_rad: f64) -> Self {
        let (sin, cos) = self.heading_rad.sin_cos();
        let x = self.x + u * cos - v * sin;
        let y = self.y + u * sin + v * cos;
        Self::new(x, y, wrap_angle(self.heading_rad + turn_rad))
    }

    /// The pose turned round on the spot.
    pub fn reversed(&self) -> Self {
        self.moved(0.0, 0.0, std::f64::consts::PI)
    }

    /// Distance in the plane, metres.
    pub fn distance_m(&self, other: &Self) -> f64 {
        (self.x - other.x).hypot(self.y - other.y)
    }
}

impl PlanCurve {
    /// A curve from its place along the road, its start and its shape.
    pub(crate) fn new(s_m: f64, start: Pose2, length_m: f64, shape: CurveShape) -> Self {
        Self {
            s_m,
            start,
            length_m,
            shape,
        }
    }

    /// Place and heading `s_m` metres after its start.
    pub fn at(&self, s_m: f64) -> Pose2 {
        let (u, v, turn) = match self.shape {
            CurveShape::Line => (s_m, 0.0, 0.0),
            CurveShape::Arc { curvature } => clothoid(curvature, 0.0, s_m),
            CurveShape::Spiral { start, end } => {
                clothoid(start, (end - start) / self.length_m, s_m)
            }
            CurveShape::Poly3(v) => poly3(v, s_m),
            CurveShape::ParamPoly3 { u, v, normalized } => {
                let p = if normalized { s_m / self.length_m } else { s_m };
                let turn = cubic_slope(v, p).atan2(cubic_slope(u, p));
                (cubic(u, p), cubic(v, p), turn)
            }
        };
        self.start.moved(u, v, turn)
    }

    /// Place and heading of its end.
    pub fn end(&self) -> Pose2 {
        self.at(self.length_m)
    }
}

/// End of a curve of length `s` that starts at the origin along x with curvature `k`, which grows by `rate` per metre:
/// u, v and heading. The Fresnel integrals by Gauss-Legendre quadrature on pieces that turn little; exact for arcs.
fn clothoid(k: f64, rate: f64, s: f64) -> (f64, f64, f64) {
    let turn = s * (k + 0.5 * rate * s);
    if rate == 0.0 {
        // Half-angle form: no loss of digits when the arc is nearly straight.
        let chord = if turn.abs() < 1e-9 {
            s
        } else {
            s * (turn / 2.0).sin() / (turn / 2.0)
        };
        return (chord * (turn / 2.0).cos(), chord * (turn / 2.0).sin(), turn);
    }
    // The curvature is linear, so one of its ends bounds the turn.
    let turned = s.abs() * k.abs().max((k + rate * s).abs());
    let pieces = (turned / GAUSS_ANGLE_RAD).ceil().clamp(1.0, 1e5) as u32;
    let half = s / f64::from(pieces) / 2.0;
    let (mut u, mut v) = (0.0, 0.0);
    for piece in 0..pieces {
        let middle = half * f64::from(2 * piece + 1);
        for (node, weight) in GAUSS {
            let t = middle + node * half;
            let (sin, cos) = (t * (k + 0.5 * rate * t)).sin_cos();
            u += weight * half * cos;
            v += weight * half * sin;
        }
    }
    (u, v, turn)
}

/// u, v and heading after `s` metres of arc along `v(u)`.
fn poly3(v: [f64; 4], s: f64) -> (f64, f64, f64) {
    // The record counts length along the arc while the polynomial counts u: march, with the slope at each middle.
    let steps = (s.abs() / 0.25).ceil().clamp(1.0, 64.0) as u32;
    let step = s / f64::from(steps);
    let mut u = 0.0;
    for _ in 0..steps {
        let half = u + 0.5 * step / 1f64.hypot(cubic_slope(v, u));
        u += step / 1f64.hypot(cubic_slope(v, half));
    }
    (u, cubic(v, u), cubic_slope(v, u).atan())
}

pub(crate) fn cubic([a, b, c, d]: [f64; 4], x: f64) -> f64 {
    a + x * (b + x * (c + x * d))
}

pub(crate) fn cubic_slope([_, b, c, d]: [f64; 4], x: f64) -> f64 {
    b + x * (2.0 * c + x * 3.0 * d)
}

#[cfg(test)]
mod tests {
    use std::f64::consts::{FRAC_PI_2, PI};

    use super::*;

    fn curve(shape: CurveShape, length_m: f64) -> PlanCurve {
        PlanCurve {
            s_m: 0.0,
            start: Pose2::new(0.0, 0.0, 0.0),
            length_m,
            shape,
        }
    }

    #[test]
    fn spiral_ends_at_the_fresnel_integrals() {
        // With heading pi/2 t^2 the clothoid of length 1 ends at (C(1), S(1)); tabulated values.
        let end = curve(
            CurveShape::Spiral {
                start: 0.0,
                end: PI,
            },
            1.0,
        )
        .end();
        assert!((end.x - 0.779_893_400_376_822_8).abs() < 1e-11, "{}", end.x);
        assert!((end.y - 0.438_259_147_390_354_8).abs() < 1e-11, "{}", end.y);
        assert!((end.heading_rad - FRAC_PI_2).abs() < 1e-12);
    }

    #[test]
    fn spiral_agrees_with_fine_numeric_integration() {
        for (start, end, length) in [(0.02, -0.05, 80.0), (-0.1, 0.3, 25.0), (0.0, 0.004, 300.0)] {
            let steps = 200_000;
            let (mut x, mut y) = (0.0, 0.0);
            for i in 0..steps {
                let t = (f64::from(i) + 0.5) / f64::from(steps) * length;
                let heading = start * t + 0.5 * (end - start) / length * t * t;
                x += heading.cos() * length / f64::from(steps);
                y += heading.sin() * length / f64::from(steps);
            }
            let found = curve(CurveShape::Spiral { start, end }, length).end();
            assert!((found.x - x).abs() < 1e-6 && (found.y - y).abs() < 1e-6);
        }
    }

    #[test]
    fn arc_of_a_quarter_circle() {
        let end = curve(CurveShape::Arc { curvature: -0.1 }, 10.0 * FRAC_PI_2).end();
        assert!((end.x - 10.0).abs() < 1e-12 && (end.y + 10.0).abs() < 1e-12);
        assert!((end.heading_rad + FRAC_PI_2).abs() < 1e-12);
    }

    #[test]
    fn every_shape_runs_at_unit_speed_along_its_heading() {
        let shapes = [
            CurveShape::Line,
            CurveShape::Arc { curvature: 0.05 },
            CurveShape::Spiral {
                start: -0.03,
                end: 0.06,
            },
            CurveShape::Poly3([0.0, 0.0, 0.01, -0.0001]),
        ];
        for shape in shapes {
            let curve = PlanCurve {
                s_m: 0.0,
                start: Pose2::new(5.0, -3.0, 2.0),
                length_m: 40.0,
                shape,
            };
            for i in 1..39 {
                let (before, at, after) = (
                    curve.at(f64::from(i) - 0.01),
                    curve.at(f64::from(i)),
                    curve.at(f64::from(i) + 0.01),
                );
                assert!(
                    (before.distance_m(&after) / 0.02 - 1.0).abs() < 1e-3,
                    "{shape:?} at {i}"
                );
                let chord = (after.y - before.y).atan2(after.x - before.x);
                assert!(
                    wrap_angle(chord - at.heading_rad).abs() < 1e-3,
                    "{shape:?} at {i}"
                );
            }
        }
    }

    #[test]
    fn param_poly3_reaches_its_end_for_both_ranges() {
        let u = [0.0, 10.0, 0.0, 0.0];
        let v = [0.0, 0.0, 3.0, -2.0];
        let normalized = curve(
            CurveShape::ParamPoly3 {
                u,
                v,
                normalized: true,
            },
            11.0,
        )
        .end();
        assert!((normalized.x - 10.0).abs() < 1e-12 && (normalized.y - 1.0).abs() < 1e-12);
        let [u, v] = [u, v].map(|[a, b, c, d]| [a, b / 11.0, c / 121.0, d / 1331.0]);
        let plain = CurveShape::ParamPoly3 {
            u,
            v,
            normalized: false,
        };
        assert!(curve(plain, 11.0).end().distance_m(&normalized) < 1e-9);
    }
}
