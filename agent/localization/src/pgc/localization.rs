//! Localization of one sweep: its pose or the reason why there is none, with evidence and time per stage.

use protocol::{NoPoseReason, PoseEstimate};
use support::stage_times::StageTimes;

use super::pose_evidence::PoseEvidence;
use super::pose_solver::{self, FoundPose, Solved};
use super::pose_std::PoseStd;

/// Stages of a localization.
pub(crate) const VOXELISE: &str = "pose voxelise";
pub(crate) const ENCODE: &str = "pose encode";
pub(crate) const REGRESS: &str = "pose regress";
pub(crate) const SOLVE: &str = "pose solve";
/// Pose refinement, its fits included.
pub(crate) const REFINE: &str = "pose refine";

/// Stopwatch of a localization.
pub fn stopwatch() -> StageTimes {
    StageTimes::of(&[VOXELISE, ENCODE, REGRESS, SOLVE, REFINE])
}

/// Result of one sweep.
#[derive(Debug, Clone, PartialEq)]
pub struct Localization {
    /// `world_from_lidar` with its confidence, or the reason why there is none.
    pub estimate: PoseEstimate,
    /// The pose with its evidence, also if `estimate` rejects it.
    pub found: Option<FoundPose>,
    /// Number of inliers.
    pub inlier_count: u32,
    /// Inliers as a share of all regressed cells, 0..=1.
    pub inlier_ratio: f64,
    /// Time per stage.
    pub times: StageTimes,
}

impl Localization {
    /// Result of a solver.
    pub fn new(solved: &Solved, times: StageTimes) -> Self {
        let found = solved.as_ref().ok().copied();
        let inliers = match solved {
            Ok(found) => found.evidence.inliers,
            Err(none) => none.inlier_count(),
        };
        Self {
            estimate: pose_solver::estimate(solved),
            found,
            inlier_count: u32::try_from(inliers).unwrap_or(u32::MAX),
            inlier_ratio: found.map_or(0.0, |found| found.evidence.inlier_ratio),
            times,
        }
    }

    /// Result without a pose and without inliers.
    pub(crate) fn no_pose(reason: NoPoseReason, times: StageTimes) -> Self {
        Self::from_estimate(PoseEstimate::no_pose(reason, 0), times)
    }

    /// Result of a method without cells: its estimate is the only evidence.
    pub fn from_estimate(estimate: PoseEstimate, times: StageTimes) -> Self {
        let found = estimate.world_from_cav().map(|world_from_cav| FoundPose {
            world_from_sensor: world_from_cav.isometry(),
            evidence: PoseEvidence::none(),
            cell_covariance: PoseStd::unbounded().covariance,
            sigma: f64::from(estimate.confidence()),
            ..FoundPose::default()
        });
        let inlier_count = match estimate {
            PoseEstimate::Pose { .. } => 0,
            PoseEstimate::NoPose { inlier_count, .. } => inlier_count,
        };
        Self {
            estimate,
            found,
            inlier_count,
            inlier_ratio: 0.0,
            times,
        }
    }
}
