//! Node of a ROS 2 network: publishes a run through rmw_zenoh's keys, and takes in sweeps of LiDARs.
//!
//! - [`RosSession`]: session on the ROS 2 network, with the tokens by which other nodes see this one.
//! - [`run()`]: from the run to the ROS 2 network, and from its LiDARs to the agents of the run.
//!
//! Run and ROS 2 network have a session each: they may have different routers, and the run may have access control.

mod initial_pose;
mod lidar_input;
mod node;
mod publisher;
mod scene_clock;
mod session;
mod sweeps;

pub use lidar_input::{LidarReport, LidarSource, LidarSourceError};
pub use node::{NodeOptions, NodeReport, run};
pub use session::RosSession;
