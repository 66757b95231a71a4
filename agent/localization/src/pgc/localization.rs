//! Localization of one sweep: its pose or the reason why there is none, with evidence and time per stage.

use std::time::Duration;

use protocol::{PoseEstimate, StageTiming};

use super::pose_evidence::PoseEvidence;
use super::pose_solver::{self, FoundPose, Solved};
use super::pose_std::PoseStd;

/// Time per stage.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct LocalizerTimes {
    /// Voxels and rulebooks from points.
    pub voxelise: Duration,
    /// Scene encoder.
    pub encode: Duration,
    /// Scene head.
    pub regress: Duration,
    /// Pose solver.
    pub solve: Duration,
    /// Pose refinement, its fits included.
    pub refine: Duration,
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
    pub times: LocalizerTimes,
}

impl Localization {
    /// Result of a solver.
    #[must_use]
    pub fn new(solved: &Solved, times: LocalizerTimes) -> Self {
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

    /// Result of a method without cells: its estimate is the only evidence.
    #[must_use]
    pub fn from_estimate(estimate: PoseEstimate, times: LocalizerTimes) -> Self {
        let (found, inlier_count) = match estimate {
            PoseEstimate::Pose {
                world_from_cav,
                confidence,
                ..
            } => {
                let (world_from_sensor, sigma) = (world_from_cav.isometry(), f64::from(confidence));
                let (evidence, cell_covariance) =
                    (PoseEvidence::none(), PoseStd::UNBOUNDED.covariance);
                (
                    Some(FoundPose {
                        world_from_sensor,
                        evidence,
                        cell_covariance,
                        sigma,
                        is_rejected: false,
                    }),
                    0,
                )
            }
            PoseEstimate::NoPose { inlier_count, .. } => (None, inlier_count),
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

impl LocalizerTimes {
    /// Stages by name, in their order.
    #[must_use]
    pub fn stages(&self) -> Vec<StageTiming> {
        let Self {
            voxelise,
            encode,
            regress,
            solve,
            refine,
        } = *self;
        [
            ("pose voxelise", voxelise),
            ("pose encode", encode),
            ("pose regress", regress),
            ("pose solve", solve),
            ("pose refine", refine),
        ]
        .map(|(stage, time)| StageTiming::new(stage, time))
        .into()
    }

    /// Sum of all stages.
    #[must_use]
    pub fn total(&self) -> Duration {
        self.voxelise + self.encode + self.regress + self.solve + self.refine
    }
}
