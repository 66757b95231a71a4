//! Pose search: from scene coordinates to a refined pose with its inliers.

use support::stage_times::StageTimes;
use tch::Kind;

use super::localization::{REFINE, SOLVE};
use super::pose_refinement::{SweepCells, refine};
use super::pose_solver::{PoseSolver, Solved};
use super::scene_coordinates::SceneCoordinates;
use super::scene_regression::SceneHead;
use crate::registration::Registration;

/// Inlier ratio from which no further search is tried.
const SUFFICIENT_RATIO: f64 = 0.6;

/// Estimates the pose of one sweep.
#[derive(Debug, Clone, Copy)]
pub struct PoseSearch<'a> {
    /// Scene-specific head.
    pub head: &'a SceneHead,
    /// Robust solver.
    pub solver: &'a PoseSolver,
    /// Cells of the pose refinement.
    pub refinement_cells: &'a SweepCells,
    /// Number format of the head.
    pub kind: Kind,
}

/// Best pose of the searches so far.
#[derive(Debug)]
pub struct Attempt {
    /// The pose, or the reason why there is none.
    pub solved: Solved,
    /// Final inlier ratio, negative without a pose.
    pub(super) inlier_ratio: f64,
}

impl Attempt {
    /// True if no further search is needed.
    pub(super) fn is_sufficient(&self) -> bool {
        self.inlier_ratio >= SUFFICIENT_RATIO
    }

    /// True if more cells are inliers than those of `other`.
    pub(super) fn is_better_than(&self, other: &Self) -> bool {
        self.inlier_ratio > other.inlier_ratio
    }

    /// The one with more inliers; the first of equal ones.
    pub(super) fn or_better(self, other: Self) -> Self {
        if other.is_better_than(&self) {
            other
        } else {
            self
        }
    }
}

impl PoseSearch<'_> {
    /// One search, for cells with `factor` times the usual error, and the refinement of its result.
    pub(super) fn attempt(
        &self,
        coordinates: &SceneCoordinates,
        factor: f64,
        times: &mut StageTimes,
    ) -> tch::Result<Attempt> {
        let coarse = self.solver.search_wider(coordinates, factor);
        times.lap(SOLVE);
        match coarse {
            Ok(coarse) => self.refined(coordinates, &coarse, factor > 1.0, times),
            Err(none) => Ok(Attempt {
                solved: Err(none),
                inlier_ratio: -1.0,
            }),
        }
    }

    /// The refinement of a coarse pose.
    pub(super) fn refined(
        &self,
        coordinates: &SceneCoordinates,
        coarse: &Registration,
        is_wide: bool,
        times: &mut StageTimes,
    ) -> tch::Result<Attempt> {
        let start = &coarse.target_from_source;
        let refined = refine(self.head, self.refinement_cells, start, is_wide, self.kind)?;
        let solved = Ok(self.solver.judge(coordinates, coarse, refined.as_ref()));
        let last = refined
            .as_ref()
            .map_or(coarse, |refined| &refined.registration);
        times.lap(REFINE);
        Ok(Attempt {
            solved,
            inlier_ratio: last.inlier_ratio,
        })
    }
}
