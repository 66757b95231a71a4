//! Ground truth of an ego from the truth message of a tick.

use dataset::frame::Frame;
use dataset::ground_truth::{GroundTruth, GroundTruthRule};
use protocol::{CavId, Truth};

/// Ground truth of the ego, in its LiDAR frame; without its true pose there is none, and no detection counts.
pub(crate) fn ground_truth(truth: &Truth, ego: &CavId, rule: &GroundTruthRule) -> GroundTruth {
    let frames: Vec<Frame> = truth.agents.iter().map(Frame::of_truth).collect();
    let ego_index = frames.iter().position(|frame| frame.cav == *ego);
    let frames: Vec<&Frame> = frames.iter().collect();
    // An index behind the last frame stands for no ego.
    GroundTruth::of_tick(&frames, ego_index.unwrap_or(frames.len()), rule)
}
