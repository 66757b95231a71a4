//! Pose search: from scene coordinates to a refined pose, with wider searches while few cells are inliers.

use std::time::{Duration, Instant};

use tch::{Kind, TchError};

use super::localize::SceneCoordinates;
use super::pose_refinement::{SweepCells, refine};
use super::pose_solver::{PoseSolver, Solved};
use super::scene_regression::SceneHead;
use crate::registration::NoRegistration;

/// Factor on the expected error of cells in each search.
const WIDENING: [f64; 3] = [1.0, 2.0, 4.0];
/// The same where a sweep is sought in one part of the scene after another.
const PART_WIDENING: f64 = 2.0;
/// Inlier ratio from which no further search is tried.
const SUFFICIENT_RATIO: f64 = 0.55;

/// Time of the two stages, over all attempts.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct SearchTimes {
    /// Searches.
    pub solve: Duration,
    /// Pose refinements, their fits included.
    pub refine: Duration,
}

/// Estimates the pose of one sweep.
#[derive(Debug, Clone, Copy)]
pub struct PoseSearch<'a> {
    /// Scene-specific head.
    pub head: &'a SceneHead,
    /// Robust solver.
    pub solver: &'a PoseSolver,
    /// Number format of the head.
    pub kind: Kind,
}

/// Best pose of the searches so far.
#[derive(Debug)]
pub struct Attempt {
    solved: Solved,
    /// Final inlier ratio, negative without a pose.
    inlier_ratio: f64,
}

impl Attempt {
    fn failed(none: NoRegistration) -> Self {
        Self { solved: Err(none), inlier_ratio: -1.0 }
    }

    /// True if no further search is needed.
    #[must_use]
    pub fn is_sufficient(&self) -> bool {
        self.inlier_ratio >= SUFFICIENT_RATIO
    }

    /// The one with more inliers; the first of equal ones.
    #[must_use]
    pub fn or_better(self, other: Self) -> Self {
        if other.inlier_ratio > self.inlier_ratio { other } else { self }
    }

    /// The pose.
    ///
    /// # Errors
    /// [`NoRegistration`] if no search found one.
    pub fn into_solved(self) -> Solved {
        self.solved
    }
}

impl PoseSearch<'_> {
    /// The pose with the most inliers after refinement; `refinement_cells` are the cells of the refinement.
    ///
    /// # Errors
    /// Those of the tensor library. A sweep without a pose is a result, not an error.
    pub fn run(
        &self,
        coordinates: &SceneCoordinates,
        refinement_cells: &SweepCells,
        times: &mut SearchTimes,
    ) -> Result<Attempt, TchError> {
        let mut best = self.attempt(coordinates, refinement_cells, WIDENING[0], times)?;
        for &factor in &WIDENING[1..] {
            if best.is_sufficient() {
                break;
            }
            best = best.or_better(self.attempt(coordinates, refinement_cells, factor, times)?);
        }
        Ok(best)
    }

    /// A single search, for scene coordinates in one of several parts of the scene.
    ///
    /// # Errors
    /// As [`Self::run`].
    pub(super) fn run_in_part(
        &self,
        coordinates: &SceneCoordinates,
        refinement_cells: &SweepCells,
        times: &mut SearchTimes,
    ) -> Result<Attempt, TchError> {
        self.attempt(coordinates, refinement_cells, PART_WIDENING, times)
    }

    /// One search, for cells with `factor` times the usual error, and the refinement of its result.
    fn attempt(
        &self,
        coordinates: &SceneCoordinates,
        refinement_cells: &SweepCells,
        factor: f64,
        times: &mut SearchTimes,
    ) -> Result<Attempt, TchError> {
        let start = Instant::now();
        let coarse = self.solver.search_wider(coordinates, factor);
        times.solve += start.elapsed();
        let coarse = match coarse {
            Ok(coarse) => coarse,
            Err(none) => return Ok(Attempt::failed(none)),
        };
        let start = Instant::now();
        let (pose, is_wide) = (coarse.target_from_source, factor > 1.0);
        let refined = refine(self.head, refinement_cells, &pose, is_wide, self.kind)?;
        let solved = Ok(self.solver.judge(coordinates, &coarse, refined.as_ref()));
        let inlier_ratio = refined.map_or(coarse.inlier_ratio, |refined| refined.registration.inlier_ratio);
        times.refine += start.elapsed();
        Ok(Attempt { solved, inlier_ratio })
    }
}
