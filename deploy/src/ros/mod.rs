//! Node of a ROS 2 network: publishes a run through rmw_zenoh's keys, and takes in sweeps of LiDARs and odometry.
//!
//! - [`RosSession`]: session on the ROS 2 network, with the tokens by which other nodes see this one.
//! - [`run()`]: from the run to the ROS 2 network, and from its LiDARs and its odometry to the agents of the run.
//!
//! Run and ROS 2 network have a session each: they may have different routers, and the run may have access control.

mod agent_topic;
mod initial_pose;
mod lidar_input;
mod motion_input;
mod node;
mod node_options;
mod other_nodes;
mod publisher;
mod refusal_log;
mod robot_frames;
mod scene_clock;
mod session;
mod stamp_check;
mod starting_pose;
mod sweeps;
mod time_series;
mod transform_tree;

pub use agent_topic::AgentTopic;
pub use lidar_input::LidarReport;
pub use motion_input::{MotionReport, MotionSource};
pub use node::{NodeReport, run};
pub use node_options::{ClockMode, NodeOptions};
pub use session::RosSession;
