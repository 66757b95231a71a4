//! Pose search: from scene coordinates to a refined pose, with wider searches if few cells are inliers.

use std::time::{Duration, Instant};

use tch::{Kind, TchError};

use super::localize::SceneCoordinates;
use super::pose_refinement::{SweepCells, refine};
use super::pose_solver::{FoundPose, PoseSolver, Solved};
use super::scene_regression::SceneHead;
use crate::registration::NoRegistration;

/// Factor on the expected error of cells in each search.
const WIDENING: [f64; 3] = [1.0, 2.0, 4.0];
/// Inlier ratio from which no further search is tried.
const SUFFICIENT_RATIO: f64 = 0.5;

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

/// Result of one search.
struct Attempt {
    found: FoundPose,
    /// Final inlier ratio.
    inlier_ratio: f64,
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
    ) -> Result<Solved, TchError> {
        let inlier_ratio = |attempt: &Result<Attempt, _>| attempt.as_ref().map_or(-1.0, |attempt| attempt.inlier_ratio);
        let mut best = self.attempt(coordinates, refinement_cells, WIDENING[0], times)?;
        for &factor in &WIDENING[1..] {
            if inlier_ratio(&best) >= SUFFICIENT_RATIO {
                break;
            }
            let next = self.attempt(coordinates, refinement_cells, factor, times)?;
            if inlier_ratio(&next) > inlier_ratio(&best) {
                best = next;
            }
        }
        Ok(best.map(|best| best.found))
    }

    /// One search, for cells with `factor` times the usual error, and the refinement of its result.
    fn attempt(
        &self,
        coordinates: &SceneCoordinates,
        refinement_cells: &SweepCells,
        factor: f64,
        times: &mut SearchTimes,
    ) -> Result<Result<Attempt, NoRegistration>, TchError> {
        let start = Instant::now();
        let coarse = self.solver.search_wider(coordinates, factor);
        times.solve += start.elapsed();
        let coarse = match coarse {
            Ok(coarse) => coarse,
            Err(none) => return Ok(Err(none)),
        };
        let start = Instant::now();
        let (pose, is_wide) = (coarse.target_from_source, factor > 1.0);
        let refined = refine(self.head, refinement_cells, &pose, is_wide, self.kind)?;
        let found = self.solver.judge(coordinates, &coarse, refined.as_ref());
        let inlier_ratio = refined.map_or(coarse.inlier_ratio, |refined| refined.registration.inlier_ratio);
        times.refine += start.elapsed();
        Ok(Ok(Attempt { found, inlier_ratio }))
    }
}
