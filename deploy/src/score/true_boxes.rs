//! Ground-truth boxes of an ego.

use dataset::frame::Frame;
use dataset::ground_truth::{self, GroundTruthRule};
use protocol::{Box3d, CavId, Truth};

/// Ground-truth boxes of the ego, in its LiDAR frame.
#[must_use]
pub(crate) fn true_boxes(truth: &Truth, ego: &CavId, rule: &GroundTruthRule) -> Vec<Box3d> {
    true_objects(truth, ego, rule)
        .into_iter()
        .map(|(_, box3d)| box3d)
        .collect()
}

/// The same with the ids of the objects.
#[must_use]
pub(crate) fn true_objects(
    truth: &Truth,
    ego: &CavId,
    rule: &GroundTruthRule,
) -> Vec<(i64, Box3d)> {
    let frames: Vec<Frame> = truth.agents.iter().map(Frame::of_truth).collect();
    let Some(ego_index) = frames.iter().position(|frame| frame.cav == *ego) else {
        return Vec::new();
    };
    ground_truth::merge(&frames.iter().collect::<Vec<_>>(), ego_index, rule)
}
