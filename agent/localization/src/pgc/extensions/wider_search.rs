//! Wider search, an extension: while few cells are inliers, a search for cells with larger errors.
//!
//! Measured gain: none apart; fog and snow need it together with the search of other parts.

use support::stage_times::StageTimes;

use crate::pgc::pose_search::{Attempt, PoseSearch};
use crate::pgc::scene_coordinates::SceneCoordinates;

/// Factor on the expected error of cells in each search.
const WIDENING: [f64; 3] = [1.0, 2.0, 4.0];

/// The refined pose with the most inliers.
///
/// # Errors
/// Those of the tensor library. A sweep without a pose is a result, not an error.
pub fn search(
    search: &PoseSearch<'_>,
    coordinates: &SceneCoordinates,
    times: &mut StageTimes,
) -> tch::Result<Attempt> {
    let [first, wider @ ..] = WIDENING;
    let mut best = search.attempt(coordinates, first, times)?;
    for factor in wider {
        if best.is_sufficient() {
            break;
        }
        best = best.or_better(search.attempt(coordinates, factor, times)?);
    }
    Ok(best)
}
