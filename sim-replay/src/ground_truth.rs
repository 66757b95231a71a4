//! Which objects an ego is expected to find: the annotations of all CAVs in range, merged.

use protocol::Box3d;

use crate::frame::Frame;

/// Where objects count, and whose annotations.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct GroundTruthRule {
    /// Lower and upper end of x in the ego's LiDAR frame, metres, both included.
    pub x_m: [f64; 2],
    /// The same for y.
    pub y_m: [f64; 2],
    /// The same for z.
    pub z_m: [f64; 2],
    /// CAVs farther than this from the ego, in the plane, do not contribute, metres.
    pub comm_range_m: f64,
    /// How many of a box's 8 corners must lie within x, y and z.
    pub min_corners: usize,
}

impl GroundTruthRule {
    /// OPV2V and V2XSet: x within 140 m, y within 40 m, z -3..1 m, all corners, 70 m of communication.
    pub const OPV2V: Self =
        Self { x_m: [-140.0, 140.0], y_m: [-40.0, 40.0], z_m: [-3.0, 1.0], comm_range_m: 70.0, min_corners: 8 };
    /// V2V4Real: x within 100 m, y within 40 m, z -5..3 m, two corners, 70 m of communication.
    pub const V2V4REAL: Self =
        Self { x_m: [-100.0, 100.0], y_m: [-40.0, 40.0], z_m: [-5.0, 3.0], comm_range_m: 70.0, min_corners: 2 };
}

/// The objects of one tick in the frame of the ego's LiDAR, by id.
///
/// `frames_of_tick` are the frames of all agents at the tick, `ego_index` is the ego's place among them.
#[must_use]
pub fn merge(frames_of_tick: &[&Frame], ego_index: usize, rule: &GroundTruthRule) -> Vec<(i64, Box3d)> {
    let _ = (frames_of_tick, ego_index, rule);
    Vec::new()
}
