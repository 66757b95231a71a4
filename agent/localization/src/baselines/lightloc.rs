//! LightLoc (Li et al. 2025): classification and regression of scene coordinates without the predicted error, the
//! refinement and the confidence that PGC adds.

use crate::pgc::localization::SOLVE;
use crate::pgc::pose_solver::PoseSolver;
use crate::pgc::{Localization, Localize, Localizer, LocalizerError, LocalizerInput};

/// The localizer's networks, whose coordinates go through a solver with equal weights.
///
/// Departs from LightLoc in that the networks are PGC's: they were trained to predict their error and towards centres
/// too.
#[derive(Debug)]
pub struct LightLoc {
    localizer: Localizer,
    solver: PoseSolver,
}

impl LightLoc {
    /// The coordinates of `localizer`, the search of `solver`.
    pub fn new(localizer: Localizer, solver: PoseSolver) -> Self {
        Self { localizer, solver }
    }
}

impl Localize for LightLoc {
    fn localize(&mut self, sweep: LocalizerInput<'_>) -> Result<Localization, LocalizerError> {
        let (mut coordinates, mut times) = self.localizer.scene_coordinates(sweep)?;
        // A predicted error of 0 gives every cell weight 1 (Eq. 6).
        coordinates.epsilon_m.fill(0.0);
        let solved = self.solver.solve(&coordinates);
        times.lap(SOLVE);
        Ok(Localization::new(&solved, times))
    }

    fn detector_encoder(&self) -> Option<&str> {
        self.localizer.detector_encoder()
    }

    fn place(&self) -> Option<&str> {
        self.localizer.place()
    }

    fn is_calibrated(&self) -> bool {
        false
    }
}
