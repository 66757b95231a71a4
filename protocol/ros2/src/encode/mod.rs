//! Messages of ROS 2 written in CDR.

mod boxes;
mod diagnostics;
mod motion;
mod mount;
mod sweep;

pub(crate) use boxes::{Marked, detections, markers, truth_marker};
pub(crate) use diagnostics::{Level, Status, diagnostics};
pub use motion::{clock, pose, static_transforms};
pub(crate) use motion::{odometry, transforms};
pub use mount::{Mount, MountError};
pub(crate) use sweep::point_cloud;
