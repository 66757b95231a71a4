//! Evidence for a pose: statistics of the cells that it was estimated from.

use nalgebra::Isometry3;
use serde::{Deserialize, Serialize};

use super::pose_refinement::RefinedPose;
use super::pose_std::PoseStd;
use super::scene_coordinates::{SceneCoordinates, sigma};
use crate::registration::Registration;

/// Statistics of the cells that a pose was estimated from.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
pub struct PoseEvidence {
    /// Number of cells of the sweep.
    pub cells: usize,
    /// Number of inliers.
    pub inliers: usize,
    /// Inliers as a share of all cells, 0..=1.
    pub inlier_ratio: f64,
    /// Root mean square of the inliers' residuals, metres.
    pub rms_m: f64,
    /// Mean of the inliers' predicted errors, metres.
    pub inlier_epsilon_m: f64,
    /// Median of all cells' predicted errors, metres.
    pub median_epsilon_m: f64,
    /// Mean of the inliers' confidences (Eq. 6), 0..=1.
    pub inlier_sigma: f64,
    /// Standard deviation of the position, from residuals and positions of the cells, metres.
    pub position_std_m: f64,
    /// Standard deviation of the orientation, radians.
    pub rotation_std_rad: f64,
    /// Evidence of the pose refinement, if there was one.
    pub second: Option<RefinementEvidence>,
}

/// Statistics of the cells in the pose refinement, which starts from a coarse pose.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct RefinementEvidence {
    /// Inliers of the refined pose as a share of the cells, 0..=1.
    pub inlier_ratio: f64,
    /// Root mean square of their residuals, metres.
    pub rms_m: f64,
    /// Median of all cells' predicted errors, metres.
    pub median_epsilon_m: f64,
    /// Mean of the inliers' confidences (Eq. 6), 0..=1.
    pub inlier_sigma: f64,
    /// Distance between coarse and refined position, metres.
    pub moved_m: f64,
    /// Lower quartile of the distances between predicted cells and their positions under the pose, metres.
    pub residual_quartile_m: f64,
    /// Sum of the last fit's weights, 1 / square metres: the inverse squares of the cells' predicted errors, weighted
    /// by the robust kernel.
    pub information_per_m2: f64,
    /// Standard deviation of the position along its worst axis, metres.
    pub worst_axis_std_m: f64,
}

impl PoseEvidence {
    /// Evidence of a registration of `coordinates` and of the pose refinement that started from it.
    pub(super) fn gather(
        coordinates: &SceneCoordinates,
        registration: &Registration,
        second: Option<&RefinedPose>,
    ) -> Self {
        let std = std_of(coordinates, registration, second);
        let start = &registration.target_from_source;
        let second = second.map(|second| RefinementEvidence::gather(start, second));
        Self::of(registration, &coordinates.epsilon_m, &std, second)
    }

    /// Evidence of a pose that was refined from a predicted one, relative to the head's origin.
    pub(super) fn of_refinement(refined: &RefinedPose, start: &Isometry3<f64>) -> Self {
        let second = RefinementEvidence::gather(start, refined);
        let epsilon_m = &refined.epsilon_m;
        Self::of(&refined.registration, epsilon_m, &refined.std, Some(second))
    }

    fn of(
        registration: &Registration,
        epsilon_m: &[f32],
        std: &PoseStd,
        second: Option<RefinementEvidence>,
    ) -> Self {
        let inliers = &registration.inliers;
        Self {
            cells: epsilon_m.len(),
            inliers: inliers.len(),
            inlier_ratio: registration.inlier_ratio,
            rms_m: registration.rms_m,
            inlier_epsilon_m: mean_over(inliers, epsilon_m, f64::from),
            median_epsilon_m: median(epsilon_m),
            inlier_sigma: mean_sigma(inliers, epsilon_m),
            position_std_m: std.position_m,
            rotation_std_rad: std.rotation_rad,
            second,
        }
    }

    /// Evidence of a pose that was not estimated from cells.
    pub(crate) fn none() -> Self {
        let unbounded = PoseStd::unbounded();
        Self {
            position_std_m: unbounded.position_m,
            rotation_std_rad: unbounded.rotation_rad,
            ..Self::default()
        }
    }

    /// Confidence without calibration: mean confidence of the inliers, from the last stage, times the inlier ratio of
    /// the first one.
    pub(crate) fn plain_sigma(&self) -> f64 {
        let first = self.inlier_sigma;
        let inlier_sigma = self.second.map_or(first, |second| second.inlier_sigma);
        (inlier_sigma * self.inlier_ratio).clamp(0.0, 1.0)
    }
}

impl RefinementEvidence {
    fn gather(start: &Isometry3<f64>, second: &RefinedPose) -> Self {
        let registration = &second.registration;
        let moved = registration.target_from_source.translation.vector - start.translation.vector;
        Self {
            inlier_ratio: registration.inlier_ratio,
            rms_m: registration.rms_m,
            median_epsilon_m: median(&second.epsilon_m),
            inlier_sigma: mean_sigma(&registration.inliers, &second.epsilon_m),
            moved_m: moved.norm(),
            residual_quartile_m: second.residual_quartile_m,
            information_per_m2: second.information_per_m2,
            worst_axis_std_m: second.std.worst_axis_m,
        }
    }
}

/// Mean confidence (Eq. 6) of some cells; 0 for none.
fn mean_sigma(cells: &[u32], epsilon_m: &[f32]) -> f64 {
    mean_over(cells, epsilon_m, |epsilon| f64::from(sigma(epsilon)))
}

/// Mean over some cells; 0 for none.
fn mean_over(cells: &[u32], epsilon_m: &[f32], value: impl Fn(f32) -> f64) -> f64 {
    let known = cells
        .iter()
        .filter_map(|&cell| epsilon_m.get(cell as usize));
    known.map(|&epsilon| value(epsilon)).sum::<f64>() / cells.len().max(1) as f64
}

/// Upper median over all cells; 0 for none. The fitted confidence model depends on this rule.
fn median(epsilon_m: &[f32]) -> f64 {
    let mut sorted = epsilon_m.to_vec();
    sorted.sort_unstable_by(f32::total_cmp);
    sorted.get(sorted.len() / 2).copied().map_or(0.0, f64::from)
}

/// Standard deviations of a pose: of the refined one, if there is one.
pub(super) fn std_of(
    coordinates: &SceneCoordinates,
    registration: &Registration,
    second: Option<&RefinedPose>,
) -> PoseStd {
    if let Some(second) = second {
        return second.std;
    }
    let pairs = coordinates.correspondences();
    let inliers = registration
        .inliers
        .iter()
        .filter_map(|&cell| pairs.get(cell as usize));
    let weighted = inliers.map(|pair| (pair, f64::from(pair.weight)));
    PoseStd::of(&registration.target_from_source, weighted)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::pgc::test_scene::SyntheticScene;
    use crate::registration::ransac::{RansacConfig, solve};

    fn evidence(scene: &SyntheticScene) -> PoseEvidence {
        let coordinates = scene.coordinates(1);
        let found = solve(&coordinates.correspondences(), &RansacConfig::default()).unwrap();
        PoseEvidence::gather(&coordinates, &found, None)
    }

    #[test]
    fn worse_cells_leave_worse_evidence() {
        let good = evidence(&SyntheticScene::default());
        let bad = evidence(&SyntheticScene {
            outliers: 0.7,
            noise_m: 0.6,
            ..SyntheticScene::default()
        });
        assert!(good.inlier_ratio > bad.inlier_ratio && good.rms_m < bad.rms_m);
        assert!(
            good.position_std_m < bad.position_std_m
                && good.rotation_std_rad < bad.rotation_std_rad
        );
        assert!(
            good.inlier_epsilon_m < bad.inlier_epsilon_m
                && good.median_epsilon_m < bad.median_epsilon_m
        );
        assert!(good.plain_sigma() > bad.plain_sigma() && bad.plain_sigma() > 0.0);
        // 300 cells with residuals of 0.2 m per axis: about 0.2 / sqrt(300) m for each of three axes.
        assert!((0.01..0.05).contains(&good.position_std_m), "{good:?}");
    }

    #[test]
    fn refinement_sets_the_confidence_of_cells_and_not_the_inlier_ratio() {
        let coordinates = SyntheticScene::default().coordinates(1);
        let pairs = coordinates.correspondences();
        let found = solve(&pairs, &RansacConfig::default()).unwrap();
        let mut sharper = Registration::judge(&pairs, found.target_from_source, 1.0);
        sharper.target_from_source.translation.vector.x += 0.3;
        let second = RefinedPose {
            registration: sharper,
            epsilon_m: vec![0.0; pairs.len()],
            residual_quartile_m: 0.1,
            std: PoseStd::unbounded(),
            information_per_m2: 400.0,
        };
        let evidence = PoseEvidence::gather(&coordinates, &found, Some(&second));
        assert!((evidence.plain_sigma() - found.inlier_ratio).abs() < 1e-9);
        assert!((evidence.second.unwrap().moved_m - 0.3).abs() < 1e-9);
    }

    #[test]
    fn no_inliers_bound_nothing() {
        let coordinates = SceneCoordinates::default();
        let nothing = Registration::judge(&[], nalgebra::Isometry3::identity(), 1.0);
        let evidence = PoseEvidence::gather(&coordinates, &nothing, None);
        assert_eq!(
            (evidence.position_std_m, evidence.plain_sigma()),
            (PoseStd::unbounded().position_m, 0.0)
        );
    }
}
