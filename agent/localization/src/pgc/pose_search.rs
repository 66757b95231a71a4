//! From scene coordinates to a sharp pose: search, look again, and where few cells agree search once more, wider.

use std::time::{Duration, Instant};

use tch::{Kind, TchError};

use super::localize::SceneCoordinates;
use super::pose_refinement::{SweepCells, refine};
use super::pose_solver::{FoundPose, PoseSolver, Solved};
use super::scene_regression::SceneHead;
use crate::registration::NoRegistration;

/// How much farther off than usual cells may be in one search after the other.
const WIDENING: [f64; 3] = [1.0, 2.0, 4.0];
/// Where so large a share of the cells agrees with a pose, nothing else is tried.
const SURE: f64 = 0.5;

/// Time of the two stages, over all attempts.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct SearchTimes {
    /// The searches.
    pub solve: Duration,
    /// The second looks, their fits included.
    pub refine: Duration,
}

/// Finds the pose of one sweep.
#[derive(Debug, Clone, Copy)]
pub struct PoseSearch<'a> {
    /// Scene-specific head.
    pub head: &'a SceneHead,
    /// Robust solver.
    pub solver: &'a PoseSolver,
    /// Numbers that the head computes in.
    pub kind: Kind,
}

/// What came of one search.
struct Attempt {
    found: FoundPose,
    /// Share of the cells that agree with it in the end.
    agreement: f64,
}

impl PoseSearch<'_> {
    /// The pose that most cells agree on in the end; `again` are the cells of the second look.
    ///
    /// # Errors
    /// The tensor library's. That there is no pose is an answer.
    pub fn run(
        &self,
        coordinates: &SceneCoordinates,
        again: &SweepCells,
        times: &mut SearchTimes,
    ) -> Result<Solved, TchError> {
        let agreement = |attempt: &Result<Attempt, _>| attempt.as_ref().map_or(-1.0, |attempt| attempt.agreement);
        let mut best = self.attempt(coordinates, again, WIDENING[0], times)?;
        for &factor in &WIDENING[1..] {
            if agreement(&best) >= SURE {
                break;
            }
            let next = self.attempt(coordinates, again, factor, times)?;
            if agreement(&next) > agreement(&best) {
                best = next;
            }
        }
        Ok(best.map(|best| best.found))
    }

    /// One search, for cells that may be off by `factor` times the usual, and the second look from where it led.
    fn attempt(
        &self,
        coordinates: &SceneCoordinates,
        again: &SweepCells,
        factor: f64,
        times: &mut SearchTimes,
    ) -> Result<Result<Attempt, NoRegistration>, TchError> {
        let start = Instant::now();
        let rough = self.solver.search_wider(coordinates, factor);
        times.solve += start.elapsed();
        let rough = match rough {
            Ok(rough) => rough,
            Err(none) => return Ok(Err(none)),
        };
        let start = Instant::now();
        let (pose, is_wide) = (rough.target_from_source, factor > 1.0);
        let second = refine(self.head, again, &pose, is_wide, self.kind)?;
        let found = self.solver.judge(coordinates, &rough, second.as_ref());
        let agreement = second.map_or(rough.inlier_ratio, |second| second.registration.inlier_ratio);
        times.refine += start.elapsed();
        Ok(Ok(Attempt { found, agreement }))
    }
}
