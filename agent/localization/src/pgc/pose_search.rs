//! Pose search: from scene coordinates to a refined pose, with wider searches while few cells are inliers.

use std::time::{Duration, Instant};

use nalgebra::{Translation3, Vector3};
use tch::{Kind, TchError};

use super::localize::SceneCoordinates;
use super::pose_refinement::{SweepCells, refine};
use super::pose_solver::{PoseSolver, Solved};
use super::scene_regression::SceneHead;
use crate::registration::{NoRegistration, Registration};

/// Factor on the expected error of cells in each search.
const WIDENING: [f64; 3] = [1.0, 2.0, 4.0];
/// The same where a sweep is sought in one part of the scene after another.
const PART_WIDENING: f64 = 2.0;
/// Inlier ratio from which no further search is tried.
const SUFFICIENT_RATIO: f64 = 0.6;
/// Starts of further refinements along the heading of a pose that few cells confirm, metres.
const AHEAD_M: [f64; 4] = [-5.0, 5.0, -10.0, 10.0];

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
    pub(super) solved: Solved,
    /// Final inlier ratio, negative without a pose.
    pub(super) inlier_ratio: f64,
}

impl Attempt {
    fn failed(none: NoRegistration) -> Self {
        Self {
            solved: Err(none),
            inlier_ratio: -1.0,
        }
    }

    /// True if no further search is needed.
    #[must_use]
    pub fn is_sufficient(&self) -> bool {
        self.inlier_ratio >= SUFFICIENT_RATIO
    }

    /// True if more cells are inliers than those of `other`.
    #[must_use]
    pub(super) fn is_better_than(&self, other: &Self) -> bool {
        self.inlier_ratio > other.inlier_ratio
    }

    /// The one with more inliers; the first of equal ones.
    #[must_use]
    pub(super) fn or_better(self, other: Self) -> Self {
        if other.is_better_than(&self) {
            other
        } else {
            self
        }
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

    /// Refinements that start before and behind the pose of `best`, which was found with `coordinates`: poles, trees
    /// and parked vehicles stand in rows, and a pose one place further along the street fits almost as well.
    ///
    /// # Errors
    /// As [`Self::run`].
    pub(super) fn run_along(
        &self,
        mut best: Attempt,
        coordinates: &SceneCoordinates,
        refinement_cells: &SweepCells,
        times: &mut SearchTimes,
    ) -> Result<Attempt, TchError> {
        let Ok(found) = &best.solved else {
            return Ok(best);
        };
        let mut origin_from_sensor = found.world_from_sensor;
        origin_from_sensor.translation.vector -= Vector3::from(coordinates.origin_m);
        for ahead_m in AHEAD_M {
            if best.is_sufficient() {
                break;
            }
            let start = origin_from_sensor * Translation3::new(ahead_m, 0.0, 0.0);
            let start = self.solver.registration_at(coordinates, start);
            best =
                best.or_better(self.refined(coordinates, &start, refinement_cells, true, times)?);
        }
        Ok(best)
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
        self.refined(coordinates, &coarse, refinement_cells, factor > 1.0, times)
    }

    /// The refinement of a coarse pose.
    fn refined(
        &self,
        coordinates: &SceneCoordinates,
        coarse: &Registration,
        refinement_cells: &SweepCells,
        is_wide: bool,
        times: &mut SearchTimes,
    ) -> Result<Attempt, TchError> {
        let start = Instant::now();
        let refined = refine(
            self.head,
            refinement_cells,
            &coarse.target_from_source,
            is_wide,
            self.kind,
        )?;
        let solved = Ok(self.solver.judge(coordinates, coarse, refined.as_ref()));
        let inlier_ratio = refined.map_or(coarse.inlier_ratio, |refined| {
            refined.registration.inlier_ratio
        });
        times.refine += start.elapsed();
        Ok(Attempt {
            solved,
            inlier_ratio,
        })
    }
}
