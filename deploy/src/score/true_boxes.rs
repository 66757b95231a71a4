//! Ground-truth boxes of an ego.

use dataset::frame::{Frame, Object, ObjectClass};
use dataset::ground_truth::{self, GroundTruthRule};
use protocol::{AgentTruth, Box3d, CavId, Handedness, Truth};

/// Ground-truth boxes of the ego, in its LiDAR frame.
#[must_use]
pub(crate) fn true_boxes(truth: &Truth, ego: &CavId, rule: &GroundTruthRule) -> Vec<Box3d> {
    true_objects(truth, ego, rule).into_iter().map(|(_, box3d)| box3d).collect()
}

/// The same with the ids of the objects.
#[must_use]
pub(crate) fn true_objects(truth: &Truth, ego: &CavId, rule: &GroundTruthRule) -> Vec<(i64, Box3d)> {
    let frames: Vec<Frame> = truth.agents.iter().map(as_frame).collect();
    let Some(ego_index) = frames.iter().position(|frame| frame.cav == *ego) else { return Vec::new() };
    ground_truth::merge(&frames.iter().collect::<Vec<_>>(), ego_index, rule)
}

/// Part of a recorded frame that the rule reads.
fn as_frame(agent: &AgentTruth) -> Frame {
    let class = |name: &str| serde_json::from_value(name.into()).unwrap_or(ObjectClass::Other);
    let objects = agent.objects.iter().map(|object| Object {
        id: object.id,
        class: class(&object.class),
        world_from_object: object.world_from_object,
        size_m: object.size_m,
        speed_mps: object.speed_mps,
    });
    Frame {
        world_from_lidar: Some(agent.world_from_lidar),
        objects: objects.collect(),
        ..Frame::empty(agent.cav.clone(), 0, Handedness::Right)
    }
}
