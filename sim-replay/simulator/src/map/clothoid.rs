//! One clothoid from a pose to a pose.
//!
//! The G1 Hermite problem: a clothoid that joins two positions with a given heading at each.
//! With the chord as x axis and the parameter t from 0 to 1, the heading along it is
//! `phi0 + (delta - a) t + a t^2`, where `phi0`, `phi1` are the headings against the chord and `delta = phi1 - phi0`;
//! `a` is the root of the lateral offset at t = 1, found by Newton's method (Bertolazzi and Frego, "G1 fitting with
//! clothoids", 2015).

use super::curve::{CurveShape, PlanCurve, Pose2};
use super::lane::wrap_angle;

/// The clothoid from `from` to `to`, beginning `s_m` along its road; a line or an arc where one fits.
///
/// Meant for turns of at most about 120 degrees against the chord at either end; beyond that the curve may loop.
pub(crate) fn between(from: Pose2, to: Pose2, s_m: f64) -> PlanCurve {
    let distance = from.distance_m(&to);
    let chord = (to.y - from.y).atan2(to.x - from.x);
    let [phi0, phi1] = [from, to].map(|pose| wrap_angle(pose.heading_rad - chord));
    if phi0.abs() < 1e-9 && phi1.abs() < 1e-9 {
        return PlanCurve::new(s_m, from, distance, CurveShape::Line);
    }
    let delta = phi1 - phi0;
    // The root for small angles, where sin x = x.
    let mut a = 3.0 * (phi0 + phi1);
    for _ in 0..30 {
        let (offset, slope, _) = integrals(phi0, delta, a);
        if offset.abs() < 1e-14 || slope.abs() < 1e-12 {
            break;
        }
        a -= offset / slope;
    }
    let (_, _, along) = integrals(phi0, delta, a);
    let length_m = distance / along;
    let (start, end) = ((delta - a) / length_m, (delta + a) / length_m);
    let straightness = (end - start).abs() * length_m;
    let shape = if straightness < 1e-9 {
        CurveShape::Arc { curvature: start }
    } else {
        CurveShape::Spiral { start, end }
    };
    PlanCurve::new(s_m, from, length_m, shape)
}

/// Integrals over 0..1 of sin(heading), of its derivative by `a`, and of cos(heading); composite Simpson.
fn integrals(phi0: f64, delta: f64, a: f64) -> (f64, f64, f64) {
    const PIECES: u32 = 256;
    let (mut sine, mut slope, mut cosine) = (0.0, 0.0, 0.0);
    for i in 0..=PIECES {
        let t = f64::from(i) / f64::from(PIECES);
        let weight = match i {
            0 | PIECES => 1.0,
            _ if i % 2 == 1 => 4.0,
            _ => 2.0,
        };
        let weight = weight / (3.0 * f64::from(PIECES));
        let (sin, cos) = (phi0 + t * (delta - a + a * t)).sin_cos();
        sine += weight * sin;
        slope += weight * cos * t * (t - 1.0);
        cosine += weight * cos;
    }
    (sine, slope, cosine)
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    proptest! {
        #[test]
        fn clothoid_arrives_where_it_was_sent(
            x in 5.0..200.0f64, y in -100.0..100.0f64, h0 in -1.4..1.4f64, h1 in -1.4..1.4f64,
        ) {
            let chord = y.atan2(x);
            let (from, to) = (Pose2::new(3.0, 4.0, chord + h0), Pose2::new(3.0 + x, 4.0 + y, chord + h1));
            let end = between(from, to, 0.0).end();
            prop_assert!(end.distance_m(&to) < 1e-5, "{:?} {:?}", end, to);
            prop_assert!(wrap_angle(end.heading_rad - to.heading_rad).abs() < 1e-9);
        }
    }

    #[test]
    fn straight_and_circular_ways_are_lines_and_arcs() {
        let line = between(
            Pose2::new(0.0, 0.0, 0.5),
            Pose2::new(0.0, 0.0, 0.5).moved(30.0, 0.0, 0.0),
            0.0,
        );
        assert_eq!(line.shape, CurveShape::Line);
        assert!((line.length_m - 30.0).abs() < 1e-12);
        let quarter = between(
            Pose2::new(0.0, 0.0, 0.0),
            Pose2::new(10.0, 10.0, std::f64::consts::FRAC_PI_2),
            0.0,
        );
        assert!(
            (quarter.length_m - 5.0 * std::f64::consts::PI).abs() < 1e-6,
            "{quarter:?}"
        );
    }
}
