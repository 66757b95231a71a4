//! Pose solver: from scene coordinates to a pose with its confidence, or to the reason why there is none.

use nalgebra::{Isometry3, Translation3};
use protocol::{NoPoseReason, PoseEstimate};

use super::confidence::Confidence;
use super::pose_evidence::{PoseEvidence, std_of};
use super::pose_refinement::RefinedPose;
use super::scene_coordinates::SceneCoordinates;
use crate::covariance_scale::CovarianceScale;
use crate::registration::ransac::{self, RansacConfig};
use crate::registration::sc2pcr::{self, Sc2PcrConfig};
use crate::registration::{NoRegistration, Registration};

/// Fewest cells of a sweep that is localized.
pub(crate) const MIN_CELLS: usize = 30;

/// Search for the pose.
#[derive(Debug, Clone, PartialEq)]
pub enum Solver {
    /// Random samples with local optimisation.
    Ransac(RansacConfig),
    /// Second-order spatial compatibility.
    Sc2Pcr(Sc2PcrConfig),
}

impl Solver {
    fn inlier_threshold_m(&self) -> f64 {
        match self {
            Self::Ransac(config) => config.inlier_threshold_m,
            Self::Sc2Pcr(config) => config.inlier_threshold_m,
        }
    }
}

impl Default for Solver {
    fn default() -> Self {
        Self::Ransac(RansacConfig::default())
    }
}

/// Solver with a confidence model.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct PoseSolver {
    /// Search for the pose.
    pub solver: Solver,
    /// Confidence of the pose.
    pub confidence: Confidence,
    /// Confidence below which a pose is rejected, beside the threshold that was fitted, 0..=1.
    pub min_confidence: f64,
    /// Scale of the pose's covariance, if it was fitted.
    pub covariance: Option<CovarianceScale>,
}

/// A pose with its evidence.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct FoundPose {
    /// Pose of the LiDAR in the world.
    pub world_from_sensor: Isometry3<f64>,
    /// Evidence for the pose.
    pub evidence: PoseEvidence,
    /// Covariance of position (metres) and rotation about the axes of the world (radians) from the residuals of the
    /// cells alone: its shape is right, but errors of neighbouring cells are correlated, so it is too small
    /// ([`crate::pose_covariance`]).
    pub cell_covariance: [[f64; 6]; 6],
    /// True if the pose was registered to a map: then `cell_covariance` is that of the registration, in full.
    pub is_registered: bool,
    /// Standard deviation per axis of the position at which that registration began, metres: a registration may end at
    /// another place the more easily, the farther away it begins. 0: not registered, or where it began was not estimated.
    pub start_std_m: f64,
    /// Fitted scale of its covariance.
    pub covariance_scale: Option<CovarianceScale>,
    /// Confidence, 0..=1.
    pub sigma: f64,
    /// True if the confidence is below the threshold: the pose is not published.
    pub is_rejected: bool,
}

/// The pose of one sweep, rejected or not, or the reason why there is none.
pub(crate) type Solved = Result<FoundPose, NoRegistration>;

impl PoseSolver {
    /// Solves one sweep.
    ///
    /// # Errors
    /// [`NoRegistration`] when there are too few cells or too few inliers.
    pub fn solve(&self, coordinates: &SceneCoordinates) -> Solved {
        self.search_wider(coordinates, 1.0)
            .map(|registration| self.judge(coordinates, &registration, None))
    }

    /// First step: the pose relative to the origin of `coordinates`, for cells with `factor` times the error. Inliers are
    /// counted as without the factor.
    ///
    /// # Errors
    /// As [`Self::solve`].
    pub(super) fn search_wider(
        &self,
        coordinates: &SceneCoordinates,
        factor: f64,
    ) -> Result<Registration, NoRegistration> {
        let pairs = coordinates.correspondences();
        if pairs.len() < MIN_CELLS {
            let (usable, given) = (pairs.len(), pairs.len());
            let none = NoRegistration::TooFewCorrespondences(usable, given, MIN_CELLS);
            return Err(none);
        }
        let found = match &self.solver {
            Solver::Ransac(config) => ransac::solve(&pairs, &config.wider(factor))?,
            Solver::Sc2Pcr(config) => sc2pcr::solve(&pairs, &config.wider(factor))?,
        };
        // A wider search counts with a wider threshold: ratios of searches must be comparable.
        let threshold_m = self.solver.inlier_threshold_m();
        Ok(match factor > 1.0 {
            true => Registration::judge(&pairs, found.target_from_source, threshold_m),
            false => found,
        })
    }

    /// A given pose relative to the origin of `coordinates`, with its inliers as in [`Self::search_wider`].
    pub(super) fn registration_at(
        &self,
        coordinates: &SceneCoordinates,
        pose: Isometry3<f64>,
    ) -> Registration {
        let threshold_m = self.solver.inlier_threshold_m();
        Registration::judge(&coordinates.correspondences(), pose, threshold_m)
    }

    /// Last step: confidence of the pose after refinement, if there was one.
    pub(super) fn judge(
        &self,
        coordinates: &SceneCoordinates,
        registration: &Registration,
        second: Option<&RefinedPose>,
    ) -> FoundPose {
        let evidence = PoseEvidence::gather(coordinates, registration, second);
        let sigma = self.confidence.sigma(&evidence);
        let last = second.map_or(registration, |second| &second.registration);
        FoundPose {
            // Added in double precision: the coordinates are single and relative to the origin.
            world_from_sensor: Translation3::from(coordinates.origin_m) * last.target_from_source,
            evidence,
            cell_covariance: std_of(coordinates, registration, second).covariance,
            covariance_scale: self.covariance,
            sigma,
            is_rejected: self.confidence.rejects(sigma) || sigma < self.min_confidence,
            ..FoundPose::default()
        }
    }
}

/// Smallest inlier ratio of a refined pose that confirms the prediction which it started from.
const CONFIRMING_RATIO: f64 = 0.4;
/// Factor on the standard deviation of a refined pose: errors of neighbouring cells are correlated.
const CORRELATION_FACTOR: f64 = 4.0;
/// Smallest error of a refined pose, metres: errors of one place repeat from sweep to sweep.
const LEAST_ERROR_M: f64 = 0.04;

/// The refined pose of a sweep whose pose was predicted as `start`, both relative to the head's origin; `None` if too
/// few cells agree with it. Sigma follows from the standard deviation of the pose by Eq. 6.
pub(super) fn confirm(
    refined: &RefinedPose,
    start: &Isometry3<f64>,
    origin_m: [f64; 3],
) -> Option<FoundPose> {
    (refined.registration.inlier_ratio >= CONFIRMING_RATIO).then(|| {
        let error_m = LEAST_ERROR_M.hypot(CORRELATION_FACTOR * refined.std.position_m);
        let origin_from_sensor = refined.registration.target_from_source;
        FoundPose {
            world_from_sensor: Translation3::from(origin_m) * origin_from_sensor,
            evidence: PoseEvidence::of_refinement(refined, start),
            cell_covariance: refined.std.covariance,
            sigma: 1.0 / (1.0 + error_m * error_m),
            ..FoundPose::default()
        }
    })
}

/// The estimate of a sweep that is published.
pub fn estimate(solved: &Solved) -> PoseEstimate {
    let (reason, inliers) = match solved {
        Ok(found) if found.is_rejected => (NoPoseReason::LowConfidence, found.evidence.inliers),
        Ok(found) => return PoseEstimate::new(found.world_from_sensor.into(), found.sigma as f32),
        Err(error @ NoRegistration::TooFewCorrespondences(..)) => {
            (NoPoseReason::TooFewPoints, error.inlier_count())
        }
        Err(error) => (NoPoseReason::TooFewInliers, error.inlier_count()),
    };
    PoseEstimate::no_pose(reason, u32::try_from(inliers).unwrap_or(u32::MAX))
}

#[cfg(test)]
mod tests {
    use nalgebra::Vector3;

    use super::*;
    use crate::pgc::confidence::ConfidenceModel;
    use crate::pgc::test_scene::SyntheticScene;

    #[test]
    fn a_sweep_is_localized_far_from_the_origin_of_the_world() {
        let scene = SyntheticScene::default();
        for solver in [Solver::default(), Solver::Sc2Pcr(Sc2PcrConfig::default())] {
            let solver = PoseSolver {
                solver,
                ..PoseSolver::default()
            };
            for seed in 0..5 {
                let solved = solver.solve(&scene.coordinates(seed));
                let found = solved.as_ref().unwrap();
                let off = scene
                    .world_from_sensor(seed)
                    .inv_mul(&found.world_from_sensor);
                assert!(off.translation.vector.norm() < 0.1, "{off}");
                assert_eq!(estimate(&solved).confidence(), found.sigma as f32);
                assert!(found.sigma > 0.5);
            }
        }
    }

    /// Largest distance between the found and the true position of some sweeps, metres.
    fn worst_off_m(scene: &SyntheticScene, factor: f64) -> f64 {
        let off_m = (0..6).map(|seed| {
            let coordinates = scene.coordinates(seed);
            let truth = scene.world_from_sensor(seed).translation.vector
                - Vector3::from(coordinates.origin_m);
            match PoseSolver::default().search_wider(&coordinates, factor) {
                Ok(found) => (found.target_from_source.translation.vector - truth).norm(),
                Err(_) => f64::INFINITY,
            }
        });
        off_m.fold(0.0, f64::max)
    }

    #[test]
    fn cells_that_are_metres_off_are_found_by_a_wider_search() {
        let scene = SyntheticScene {
            noise_m: 2.5,
            outliers: 0.3,
            ..SyntheticScene::default()
        };
        let [wide_m, narrow_m] = [4.0, 1.0].map(|factor| worst_off_m(&scene, factor));
        assert!(wide_m < 1.5 && wide_m < narrow_m, "{wide_m} {narrow_m}");
    }

    fn no_pose_reason(scene: &SyntheticScene) -> Option<NoPoseReason> {
        match estimate(&PoseSolver::default().solve(&scene.coordinates(3))) {
            PoseEstimate::NoPose { reason, .. } => Some(reason),
            PoseEstimate::Pose { .. } => None,
        }
    }

    #[test]
    fn thin_evidence_gives_no_pose_but_a_reason() {
        let scene = SyntheticScene::default();
        assert_eq!(no_pose_reason(&scene), None);
        assert_eq!(
            no_pose_reason(&SyntheticScene {
                cells: 0,
                ..scene.clone()
            }),
            Some(NoPoseReason::TooFewPoints)
        );
        assert_eq!(
            no_pose_reason(&SyntheticScene {
                cells: 10,
                ..scene.clone()
            }),
            Some(NoPoseReason::TooFewPoints)
        );
        assert_eq!(
            no_pose_reason(&SyntheticScene {
                outliers: 1.0,
                ..scene
            }),
            Some(NoPoseReason::TooFewInliers)
        );
    }

    #[test]
    fn nan_gives_no_pose() {
        let mut coordinates = SyntheticScene::default().coordinates(1);
        coordinates
            .world_m
            .iter_mut()
            .for_each(|point| point[1] = f32::NAN);
        let none = estimate(&PoseSolver::default().solve(&coordinates));
        assert!(matches!(
            none,
            PoseEstimate::NoPose {
                reason: NoPoseReason::TooFewPoints,
                ..
            }
        ));
        let mut coordinates = SyntheticScene::default().coordinates(1);
        coordinates
            .epsilon_m
            .iter_mut()
            .for_each(|epsilon| *epsilon = f32::NAN);
        assert!(PoseSolver::default().solve(&coordinates).is_err());
    }

    #[test]
    fn a_pose_with_little_evidence_is_rejected_with_its_inliers() {
        let strict = ConfidenceModel {
            reject_below: 0.99,
            ..ConfidenceModel::example()
        };
        let solver = PoseSolver {
            confidence: Confidence::Calibrated(strict),
            ..PoseSolver::default()
        };
        let scene = SyntheticScene {
            outliers: 0.8,
            noise_m: 0.6,
            ..SyntheticScene::default()
        };
        let solved = solver.solve(&scene.coordinates(1));
        let found = solved.as_ref().unwrap();
        let PoseEstimate::NoPose {
            reason,
            inlier_count,
        } = estimate(&solved)
        else {
            panic!("{solved:?}")
        };
        assert_eq!(
            (reason, inlier_count as usize),
            (NoPoseReason::LowConfidence, found.evidence.inliers)
        );
    }
}
