//! Planar fit: the motion of an upright vehicle (heading and translation, no slope) that fits pairs of points best.

use nalgebra::{Isometry3, Translation3, UnitQuaternion, Vector2, Vector3};

/// Below this spread of the points about their mean the heading is undetermined, metres.
const MIN_SPREAD_M: f64 = 0.1;

/// `target_from_source` from pairs of (source, target), metres, with the least sum of squared horizontal residuals;
/// height is the mean difference. `None` when the points lie on one place or there is none.
pub fn fit<I>(pairs: &I) -> Option<Isometry3<f64>>
where
    I: Iterator<Item = (Vector3<f64>, Vector3<f64>)> + Clone,
{
    let count = pairs.clone().count() as f64;
    let sums = pairs
        .clone()
        .fold((Vector3::zeros(), Vector3::zeros()), |sums, pair| {
            (sums.0 + pair.0, sums.1 + pair.1)
        });
    // NaN without pairs. The spread is then zero, and nothing is returned.
    let (from, to): (Vector3<f64>, Vector3<f64>) = (sums.0 / count, sums.1 / count);
    let (mut dot, mut cross, mut spread) = (0.0, 0.0, 0.0);
    for (source, target) in pairs.clone() {
        let [a, b]: [Vector2<f64>; 2] = [(source - from).xy(), (target - to).xy()];
        dot += a.dot(&b);
        cross += a.perp(&b);
        spread += a.norm_squared();
    }
    if spread.is_nan() || spread < MIN_SPREAD_M * MIN_SPREAD_M {
        return None;
    }
    // Least squares in closed form: sine and cosine are in proportion to the sums of cross and dot products.
    let rotation = UnitQuaternion::from_axis_angle(&Vector3::z_axis(), cross.atan2(dot));
    let shift = Translation3::from(to - rotation * from);
    Some(Isometry3::from_parts(shift, rotation))
}

/// Matches by their distances, nearest first: each index occurs once on either side.
pub fn one_to_one(mut near: Vec<(f64, (usize, usize))>) -> Vec<(usize, usize)> {
    near.sort_by(|one, other| one.0.total_cmp(&other.0));
    let mut matches: Vec<(usize, usize)> = Vec::with_capacity(near.len());
    for (_, pair) in near {
        let mut known = matches.iter();
        if known.all(|known| known.0 != pair.0 && known.1 != pair.1) {
            matches.push(pair);
        }
    }
    matches
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn heading_and_shift_are_found_and_a_single_place_fixes_none() {
        let truth = Isometry3::new(Vector3::new(30.0, -12.0, 0.4), Vector3::z() * -2.8);
        let points = [[0.0, 0.0, 0.0], [10.0, 2.0, 0.3], [-4.0, 7.0, -0.2]].map(Vector3::from);
        let pairs = points
            .iter()
            .map(|point| (*point, truth.rotation * point + truth.translation.vector));
        let off = truth.inv_mul(&fit(&pairs).unwrap());
        assert!(off.translation.vector.norm() < 1e-9 && off.rotation.angle() < 1e-9);
        assert_eq!(fit(&pairs.clone().take(1)), None);
        assert_eq!(fit(&pairs.take(0)), None);
    }

    #[test]
    fn a_mirror_image_is_not_fitted_by_mirroring() {
        let points = [[0.0, 0.0, 0.0], [10.0, 0.0, 0.0], [3.0, 8.0, 0.0]].map(Vector3::from);
        let pairs = points
            .iter()
            .map(|point| (*point, Vector3::new(point.x, -point.y, 0.0)));
        let found = fit(&pairs).unwrap();
        let worst = pairs
            .map(|(a, b)| (found.rotation * a + found.translation.vector - b).norm())
            .fold(0.0, f64::max);
        assert!(worst > 2.0, "{worst}");
    }
}
