//! Plausibility of annotated boxes as a whole: boxes in wrong frames or units can be valid one by one.

use protocol::{CavId, PointCloud, Pose};

use super::cells::PointCells;
use crate::Problem;
use crate::frame::Frame;

/// Least number of boxes of an agent for which shares are evaluated.
const ENOUGH_BOXES: usize = 20;
/// Largest share of boxes without any of the agent's own points, of those in frames with points.
const MAX_EMPTY_SHARE: f64 = 0.5;
const HINT: &str = "frames (axes, order of the pose's numbers) or units of the boxes may be wrong";

/// The finding that agents list `targets` objects of the protocol's classes, and none is ground truth of any ego.
pub fn without_ground_truth(scenario: &str, targets: usize, merged: usize) -> Option<Problem> {
    let reason = format!(
        "ground truth 0 for every ego and tick, though agents list {targets} objects of its classes: {HINT}"
    );
    (targets > 0 && merged == 0).then(|| Problem::about(scenario, "ground truth", &reason))
}

/// The finding that most boxes of an agent are empty: `empty` of the `boxes` of frames with points and a pose.
pub(super) fn mostly_empty(
    scenario: &str,
    agent: &CavId,
    boxes: usize,
    empty: usize,
) -> Option<Problem> {
    let share = empty as f64 / boxes.max(1) as f64;
    let reason = format!(
        "agent {agent}: {empty} of {boxes} boxes ({:.0} %) hold none of its points: {HINT}",
        100.0 * share
    );
    (boxes >= ENOUGH_BOXES && share > MAX_EMPTY_SHARE)
        .then(|| Problem::about(scenario, "boxes", &reason))
}

/// Number of boxes that hold none of the points.
pub(super) fn without_points(frame: &Frame, world_from_lidar: &Pose, points: &PointCloud) -> usize {
    let (cells, world_from_lidar) = (PointCells::new(points), world_from_lidar.isometry());
    let empty = frame.objects.iter().filter(|object| {
        let world_from_object = object.world_from_object.isometry();
        let object_from_lidar = world_from_object.inv_mul(&world_from_lidar);
        #[expect(clippy::cast_possible_truncation, reason = "rounded to f32")]
        let half = object.size_m.map(|size| (size / 2.0) as f32);
        !cells.holds_point(&object_from_lidar.cast::<f32>(), half)
    });
    empty.count()
}
