//! What speaks for a pose that was found.

use serde::{Deserialize, Serialize};

use super::localize::{SceneCoordinates, sigma};
use super::pose_refinement::RefinedPose;
use super::pose_std::PoseStd;
use crate::registration::Registration;

/// Facts about the cells that a pose was found from.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct PoseEvidence {
    /// Cells of the sweep.
    pub cells: usize,
    /// Cells that agree with the pose.
    pub inliers: usize,
    /// Share of them.
    pub inlier_ratio: f64,
    /// Root mean square of the inliers' residuals, metres.
    pub rms_m: f64,
    /// Mean of the inliers' predicted errors, metres.
    pub inlier_epsilon_m: f64,
    /// Median of all cells' predicted errors, metres.
    pub median_epsilon_m: f64,
    /// Mean of the inliers' confidences (Eq. 6), 0..=1.
    pub inlier_sigma: f64,
    /// Standard deviation of the position that the cells' residuals and places leave, metres.
    pub position_std_m: f64,
    /// The same of the orientation, radians.
    pub rotation_std_rad: f64,
    /// What a second look had to say, where there was one.
    pub second: Option<RefinementEvidence>,
}

/// Facts about the cells when they were looked at again, with the pose known roughly.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct RefinementEvidence {
    /// Share of the cells that agree with the sharpened pose.
    pub inlier_ratio: f64,
    /// Root mean square of their residuals, metres.
    pub rms_m: f64,
    /// Median of all cells' predicted errors, metres.
    pub median_epsilon_m: f64,
    /// Mean of the agreeing cells' confidences (Eq. 6), 0..=1.
    pub inlier_sigma: f64,
    /// How far the second look moved the pose, metres.
    pub moved_m: f64,
    /// A quarter of all cells answer nearer than this to where the pose puts them, metres.
    pub residual_quartile_m: f64,
    /// Sum of the last fit's weights, the inverse squares of the cells' predicted errors as far as the fit listened to them,
    /// 1 / square metres.
    pub information_per_m2: f64,
    /// Standard deviation of the position along the axis that is known worst, metres.
    pub worst_axis_std_m: f64,
}

impl PoseEvidence {
    /// Looks at a registration of `coordinates` and at the second look that started from it.
    #[must_use]
    pub(super) fn gather(
        coordinates: &SceneCoordinates,
        registration: &Registration,
        second: Option<&RefinedPose>,
    ) -> Self {
        let std = second.map_or_else(|| first_std(coordinates, registration), |second| second.std);
        Self {
            cells: coordinates.sensor_m.len(),
            inliers: registration.inliers.len(),
            inlier_ratio: registration.inlier_ratio,
            rms_m: registration.rms_m,
            inlier_epsilon_m: mean_over(&registration.inliers, &coordinates.epsilon_m, f64::from),
            median_epsilon_m: median(&coordinates.epsilon_m),
            inlier_sigma: mean_over(&registration.inliers, &coordinates.epsilon_m, |epsilon| f64::from(sigma(epsilon))),
            position_std_m: std.position_m,
            rotation_std_rad: std.rotation_rad,
            second: second.map(|second| RefinementEvidence::gather(registration, second)),
        }
    }

    /// Of a pose that was not found from cells: nothing speaks for it but the answer itself.
    #[must_use]
    pub(super) fn none() -> Self {
        Self {
            cells: 0,
            inliers: 0,
            inlier_ratio: 0.0,
            rms_m: 0.0,
            inlier_epsilon_m: 0.0,
            median_epsilon_m: 0.0,
            inlier_sigma: 0.0,
            position_std_m: PoseStd::UNBOUNDED.position_m,
            rotation_std_rad: PoseStd::UNBOUNDED.rotation_rad,
            second: None,
        }
    }

    /// Confidence without any calibration: mean confidence of the inliers, as last known, times the share of cells that
    /// agreed when nothing was known yet.
    #[must_use]
    pub fn plain_sigma(&self) -> f64 {
        let inlier_sigma = self.second.map_or(self.inlier_sigma, |second| second.inlier_sigma);
        (inlier_sigma * self.inlier_ratio).clamp(0.0, 1.0)
    }
}

impl RefinementEvidence {
    fn gather(first: &Registration, second: &RefinedPose) -> Self {
        let RefinedPose { registration, epsilon_m, residual_quartile_m, std, information_per_m2 } = second;
        let moved = registration.target_from_source.translation.vector - first.target_from_source.translation.vector;
        Self {
            inlier_ratio: registration.inlier_ratio,
            rms_m: registration.rms_m,
            median_epsilon_m: median(epsilon_m),
            inlier_sigma: mean_over(&registration.inliers, epsilon_m, |epsilon| f64::from(sigma(epsilon))),
            moved_m: moved.norm(),
            residual_quartile_m: *residual_quartile_m,
            information_per_m2: *information_per_m2,
            worst_axis_std_m: std.worst_axis_m,
        }
    }
}

/// Mean over some cells; 0 for none.
fn mean_over(cells: &[u32], epsilon_m: &[f32], value: impl Fn(f32) -> f64) -> f64 {
    let values = cells.iter().filter_map(|&cell| epsilon_m.get(cell as usize)).map(|&epsilon| value(epsilon));
    values.sum::<f64>() / cells.len().max(1) as f64
}

/// Upper median over all cells; 0 for none. Input of the fitted confidence model, which knows this rule.
fn median(epsilon_m: &[f32]) -> f64 {
    let mut sorted = epsilon_m.to_vec();
    let middle = sorted.len() / 2;
    if sorted.is_empty() { 0.0 } else { f64::from(*sorted.select_nth_unstable_by(middle, f32::total_cmp).1) }
}

/// Spread of the pose of a first look: its inliers count by their confidences.
fn first_std(coordinates: &SceneCoordinates, registration: &Registration) -> PoseStd {
    let pairs = coordinates.correspondences();
    let inliers = registration.inliers.iter().filter_map(|&cell| pairs.get(cell as usize));
    PoseStd::of(&registration.target_from_source, inliers.map(|pair| (pair, f64::from(pair.weight))))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::pgc::synthetic::SyntheticScene;
    use crate::registration::ransac::{RansacConfig, solve};

    fn evidence(town: &SyntheticScene) -> PoseEvidence {
        let coordinates = town.coordinates(1);
        let found = solve(&coordinates.correspondences(), &RansacConfig::default()).unwrap();
        PoseEvidence::gather(&coordinates, &found, None)
    }

    #[test]
    fn worse_cells_leave_worse_evidence() {
        let good = evidence(&SyntheticScene::default());
        let bad = evidence(&SyntheticScene { outliers: 0.7, noise_m: 0.6, ..SyntheticScene::default() });
        assert!(good.inlier_ratio > bad.inlier_ratio && good.rms_m < bad.rms_m);
        assert!(good.position_std_m < bad.position_std_m && good.rotation_std_rad < bad.rotation_std_rad);
        assert!(good.inlier_epsilon_m < bad.inlier_epsilon_m && good.median_epsilon_m < bad.median_epsilon_m);
        assert!(good.plain_sigma() > bad.plain_sigma() && bad.plain_sigma() > 0.0);
        // 300 cells with residuals of 0.2 m per axis: about 0.2 / sqrt(300) m for each of three axes.
        assert!((0.01..0.05).contains(&good.position_std_m), "{good:?}");
    }

    #[test]
    fn a_second_look_decides_the_confidence_of_cells_and_not_their_share() {
        let coordinates = SyntheticScene::default().coordinates(1);
        let pairs = coordinates.correspondences();
        let found = solve(&pairs, &RansacConfig::default()).unwrap();
        let mut sharper = Registration::judge(&pairs, found.target_from_source, 1.0);
        sharper.target_from_source.translation.vector.x += 0.3;
        let second = RefinedPose {
            registration: sharper,
            epsilon_m: vec![0.0; pairs.len()],
            residual_quartile_m: 0.1,
            std: PoseStd::UNBOUNDED,
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
        assert_eq!((evidence.position_std_m, evidence.plain_sigma()), (PoseStd::UNBOUNDED.position_m, 0.0));
    }
}
