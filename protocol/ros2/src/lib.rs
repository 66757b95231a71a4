//! ROS 2 without ROS: messages in CDR, type hashes, and the keys, tokens and attachments of rmw_zenoh.
//!
//! This crate links no network. The recorder writes what [`Translator`] makes of a message into bags, `v2vloc ros2`
//! publishes the same on a ROS 2 network, and reads sweeps of LiDARs with [`read_point_cloud`], odometry and gyroscopes
//! with [`MotionType::read`], poses and transforms with [`PoseType::read`].
//!
//! | topic | type | from | quality of service |
//! | --- | --- | --- | --- |
//! | `/cav_<id>/pose` | `geometry_msgs/PoseWithCovarianceStamped` | pose of an agent | reliable, 10 |
//! | `/cav_<id>/odometry` | `nav_msgs/Odometry` | the same, with the speed and yaw rate of the vehicle's own sensors | reliable, 10 |
//! | `/cav_<id>/points` | `sensor_msgs/PointCloud2` | sweep | best effort, 5 |
//! | `/cav_<id>/detections` | `vision_msgs/Detection3DArray` | detections of an ego | reliable, 10 |
//! | `/cav_<id>/markers` | `visualization_msgs/MarkerArray` | the same, for viewers | reliable, 10 |
//! | `/cav_<id>/tracks` | `vision_msgs/Detection3DArray` | tracks of an ego, `id` is the identity | reliable, 10 |
//! | `/cav_<id>/track_markers` | `visualization_msgs/MarkerArray` | the same, for viewers | reliable, 10 |
//! | `/tf` | `tf2_msgs/TFMessage` | `map` to `cav_<id>/lidar`, or to the odometry frame of a robot | reliable, 100 |
//! | `/tf_static` | `tf2_msgs/TFMessage` | `cav_<id>/lidar` to `cav_<id>/base_link` | reliable, latched, 1 |
//! | `/clock` | `rosgraph_msgs/Clock` | capture times | best effort, 1 |
//! | `/diagnostics` | `diagnostic_msgs/DiagnosticArray` | statistics of a process | reliable, 10 |
//! | `/initialpose` | `geometry_msgs/PoseWithCovarianceStamped` | first fix of one vehicle, if asked for | reliable, 10 |
//! | `/truth` | `visualization_msgs/MarkerArray` | ground truth, in recordings only | reliable, 10 |
//!
//! Header stamps are capture times, in nanoseconds on the scene's clock. Axes and units are those of [`protocol`] and of
//! REP-103: right-handed, x forward, metres, radians.

// This crate reads what other processes wrote: an index or a cast that does not fit is an error there, not a panic or
// another number.
#![cfg_attr(not(test), deny(clippy::cast_possible_truncation))]
#![cfg_attr(not(test), deny(clippy::cast_sign_loss))]
#![cfg_attr(not(test), deny(clippy::indexing_slicing))]

mod cdr;
mod definitions;
mod encode;
pub mod endpoint;
mod motion;
pub mod names;
mod point_cloud;
mod qos;
mod read;
mod ros_type;
mod stated_pose;
mod topic;
mod transforms;
mod translator;
mod type_hash;

pub use encode::{
    FrameInParent, Mount, MountError, body_in_lidar, clock, pose, static_transforms, transforms,
};
pub use motion::MotionType;
pub use names::{FrameNames, NameError, RosName};
pub use point_cloud::{RosSweep, read_point_cloud};
pub use qos::Qos;
pub use read::ReadError;
pub use ros_type::RosType;
pub use stated_pose::StatedPose;
pub use topic::{RosTopic, VehicleTopic};
pub use transforms::{PoseType, Transform, read_header};
pub use translator::{RosMessage, Translator};
pub use type_hash::Distribution;
