//! Messages of ROS 2 written in CDR.

mod boxes;
mod camera;
mod diagnostics;
mod motion;
mod mount;
mod sweep;

pub(crate) use boxes::{Marked, detections, markers, tracks, truth_marker};
pub(crate) use camera::{camera_info, compressed_image};
pub(crate) use diagnostics::{Status, diagnostics};
pub(crate) use motion::odometry;
pub use motion::{FrameInParent, body_in_lidar, clock, pose, static_transforms, transforms};
pub use mount::{Mount, MountError};
pub(crate) use sweep::point_cloud;
