//! Planar poses: position and heading, as numbers for networks and corrected by an offset.

use protocol::Pose;

/// x and y, metres, and heading, radians.
pub(crate) fn planar(pose: &Pose) -> [f32; 3] {
    let [x, y, _] = pose.translation_m;
    [x, y, pose.yaw_rad()].map(|value| value as f32)
}

/// A pose shifted along x and y of its reference frame, metres, and rotated about its own position, radians. Roll and
/// pitch are dropped.
pub fn moved(pose: &Pose, [dx, dy, turn_rad]: [f64; 3]) -> Pose {
    let [x, y, z] = pose.translation_m;
    Pose::from_xyz_yaw([x + dx, y + dy, z], pose.yaw_rad() + turn_rad)
}
