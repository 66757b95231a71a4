//! Kabsch's algorithm: the rigid motion that fits weighted pairs best (Kabsch 1976, with the determinant kept at +1).

use nalgebra::{Isometry3, Matrix3, Rotation3, SVD, UnitQuaternion, Vector3};

/// Ratio of the second to the first singular value below which the pairs lie on a line, and any rotation about it fits.
const COLLINEAR: f64 = 1e-9;
/// Largest number of iterations of the 3x3 decomposition; it needs about ten.
const MAX_SVD_ITERATIONS: usize = 200;

/// Reason why pairs do not constrain a rigid motion.
#[derive(Debug, Clone, Copy, PartialEq, thiserror::Error)]
pub enum Degenerate {
    /// No pair has a positive weight.
    #[error("the weights sum up to {0}")]
    NoWeight(f64),
    /// A coordinate or weight is NaN, infinite or so large that its square is.
    #[error("a coordinate or weight is not finite")]
    NotFinite,
    /// The points coincide or lie on one line.
    #[error("the points lie on a line: second singular value is {0:.1e} of the first")]
    Collinear(f64),
}

/// Sums over weighted pairs of a source point `a` and a target point `b` that a fit needs, metres.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct PairMoments {
    weight: f64,
    source: Vector3<f64>,
    target: Vector3<f64>,
    /// Sum of `w a b^T`.
    cross: Matrix3<f64>,
}

impl PairMoments {
    /// Adds one pair; a weight of zero changes nothing.
    pub fn add(&mut self, source_m: &Vector3<f64>, target_m: &Vector3<f64>, weight: f64) {
        let weighted = source_m * weight;
        self.weight += weight;
        self.source += weighted;
        self.target += target_m * weight;
        self.cross += weighted * target_m.transpose();
    }

    /// `target_from_source` with the least weighted sum of squared residuals.
    ///
    /// # Errors
    /// [`Degenerate`] when the pairs do not constrain it.
    pub fn fit(&self) -> Result<Isometry3<f64>, Degenerate> {
        self.fit_biased(0.0)
    }

    /// The same with `epsilon` added to the sum of weights that the centroids are divided by, as in implementations
    /// that guard against a division by zero; it pulls both centroids towards their origins.
    ///
    /// # Errors
    /// See [`Self::fit`].
    pub fn fit_biased(&self, epsilon: f64) -> Result<Isometry3<f64>, Degenerate> {
        let (weight, source, target) = (self.weight, self.source, self.target);
        let mut sums = self.cross.iter().chain(source.iter()).chain(target.iter());
        if !(weight.is_finite() && sums.all(|sum| sum.is_finite())) {
            return Err(Degenerate::NotFinite);
        }
        if weight <= 0.0 {
            return Err(Degenerate::NoWeight(weight));
        }
        let from = source / (weight + epsilon);
        let to = target / (weight + epsilon);
        // Sum of w (a - from) (b - to)^T, multiplied out. With a bias its last three terms do not merge.
        let covariance = self.cross - from * target.transpose() - source * to.transpose()
            + from * to.transpose() * weight;
        let rotation = rotation_of(&(covariance / weight))?;
        let turn = UnitQuaternion::from_rotation_matrix(&rotation);
        Ok(Isometry3::from_parts((to - rotation * from).into(), turn))
    }
}

/// The rotation `R` that maximises `trace(R H)` for the covariance `H` of source and target.
fn rotation_of(covariance: &Matrix3<f64>) -> Result<Rotation3<f64>, Degenerate> {
    let svd = SVD::try_new(*covariance, true, true, f64::EPSILON, MAX_SVD_ITERATIONS)
        .ok_or(Degenerate::NotFinite)?;
    let (Some(u), Some(v_t)) = (svd.u, svd.v_t) else {
        return Err(Degenerate::NotFinite);
    };
    let mut order = [0, 1, 2];
    order.sort_by(|&a, &b| svd.singular_values[b].total_cmp(&svd.singular_values[a]));
    let [first, second, last] = order;
    let ratio = svd.singular_values[second] / svd.singular_values[first];
    // 0 / 0 if all points coincide.
    let ratio = if ratio.is_nan() { 0.0 } else { ratio };
    if ratio <= COLLINEAR {
        return Err(Degenerate::Collinear(ratio));
    }
    // With H = U S V^T the rotation is R = V U^T.
    let mut v = v_t.transpose();
    if (v * u.transpose()).determinant() < 0.0 {
        // The best orthogonal matrix is a reflection: negating its weakest axis gives the best rotation.
        v.column_mut(last).neg_mut();
    }
    Ok(Rotation3::from_matrix_unchecked(v * u.transpose()))
}

#[cfg(test)]
mod tests {
    use std::f64::consts::PI;

    use nalgebra::Translation3;
    use proptest::prelude::*;

    use super::*;

    fn fit(pairs: &[(Vector3<f64>, Vector3<f64>, f64)]) -> Result<Isometry3<f64>, Degenerate> {
        let mut moments = PairMoments::default();
        pairs
            .iter()
            .for_each(|(a, b, weight)| moments.add(a, b, *weight));
        moments.fit()
    }

    fn any_motion() -> impl Strategy<Value = Isometry3<f64>> {
        (
            prop::array::uniform3(-1e5..1e5),
            prop::array::uniform3(-PI..PI),
        )
            .prop_map(|(t, r)| {
                Isometry3::from_parts(
                    Translation3::from(t),
                    UnitQuaternion::from_euler_angles(r[0], r[1], r[2]),
                )
            })
    }

    fn any_points() -> impl Strategy<Value = Vec<(Vector3<f64>, f64)>> {
        let point = prop::array::uniform3(-80.0..80.0).prop_map(Vector3::from);
        prop::collection::vec((point, 0.01..1.0), 4..40)
    }

    proptest! {
        #[test]
        fn a_motion_is_found_again(motion in any_motion(), points in any_points()) {
            let pairs: Vec<_> = points.iter().map(|&(p, w)| (p, motion.transform_vector(&p) + motion.translation.vector, w)).collect();
            let error = motion.inv_mul(&fit(&pairs).unwrap());
            prop_assert!(error.rotation.angle() < 1e-5, "{}", error.rotation.angle());
            prop_assert!(error.translation.vector.norm() < 1e-3, "{}", error.translation.vector.norm());
        }

        #[test]
        fn any_numbers_give_a_rotation_or_a_reason(
            numbers in prop::collection::vec(prop::array::uniform7(prop::num::f64::ANY), 0..6),
        ) {
            let pairs: Vec<_> =
                numbers.iter().map(|n| (Vector3::new(n[0], n[1], n[2]), Vector3::new(n[3], n[4], n[5]), n[6])).collect();
            if let Ok(motion) = fit(&pairs) {
                prop_assert!((motion.rotation.norm() - 1.0).abs() < 1e-6);
            }
        }
    }

    /// Corners of a box, no two edges alike.
    fn corners() -> [Vector3<f64>; 4] {
        [
            [0.0, 0.0, 0.0],
            [4.0, 0.0, 0.0],
            [0.0, 2.0, 0.0],
            [0.0, 0.0, 1.0],
        ]
        .map(Vector3::from)
    }

    #[test]
    fn a_mirror_image_still_gives_a_rotation() {
        let box_corners = (0..8).map(|corner| {
            Vector3::from_fn(|axis, _| {
                let reach: f64 = [4.0, 2.0, 1.0][axis];
                if corner >> axis & 1 == 0 {
                    -reach
                } else {
                    reach
                }
            })
        });
        let pairs: Vec<_> = box_corners
            .map(|p| (p, Vector3::new(p.x, p.y, -p.z), 1.0))
            .collect();
        let motion = fit(&pairs).unwrap();
        assert!((motion.rotation.to_rotation_matrix().matrix().determinant() - 1.0).abs() < 1e-12);
        // The identity is best: the mirrored axis is the shortest.
        assert!(
            motion.rotation.angle() < 1e-9,
            "{}",
            motion.rotation.angle()
        );
    }

    /// Points, each with itself turned.
    fn turned(
        points: &[Vector3<f64>],
        turn: UnitQuaternion<f64>,
    ) -> Vec<(Vector3<f64>, Vector3<f64>, f64)> {
        points.iter().map(|p| (*p, turn * p, 1.0)).collect()
    }

    #[test]
    fn a_plane_is_enough_and_a_line_is_not() {
        let turn = UnitQuaternion::from_euler_angles(0.3, -0.2, 1.0);
        let plane = [[0.0, 0.0, 1.0], [4.0, 0.0, 1.0], [0.0, 2.0, 1.0]].map(Vector3::from);
        assert!((fit(&turned(&plane, turn)).unwrap().rotation.angle_to(&turn)) < 1e-9);
        let line = [0.0, 1.0, 5.0].map(|x| Vector3::new(x, 2.0 * x, 1.0));
        assert!(matches!(
            fit(&turned(&line, turn)),
            Err(Degenerate::Collinear(_))
        ));
        assert!(matches!(
            fit(&turned(&line[..1], turn)),
            Err(Degenerate::Collinear(_))
        ));
    }

    #[test]
    fn invalid_pairs_are_an_error() {
        let [a, b, c, _] = corners();
        assert_eq!(fit(&[]), Err(Degenerate::NoWeight(0.0)));
        assert_eq!(
            fit(&[(a, a, 0.0), (b, b, 0.0)]),
            Err(Degenerate::NoWeight(0.0))
        );
        assert_eq!(
            fit(&[(a, a, 1.0), (b, b, f64::NAN), (c, c, 1.0)]),
            Err(Degenerate::NotFinite)
        );
        assert_eq!(
            fit(&[(a, a, 1.0), (b, b * f64::MAX, 1.0), (c, c, 1.0)]),
            Err(Degenerate::NotFinite)
        );
    }

    #[test]
    fn pairs_count_by_their_weights() {
        let shifted = corners().map(|p| (p, p + Vector3::x(), 1.0));
        let elsewhere = corners().map(|p| (p, p - Vector3::x() * 5.0, 1e-9));
        let motion = fit(&[shifted, elsewhere].concat()).unwrap();
        assert!((motion.translation.vector - Vector3::x()).norm() < 1e-6);
    }
}
