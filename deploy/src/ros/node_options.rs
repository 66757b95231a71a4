//! Options of the node.

use dataset::IntensityScale;
use protocol::CavId;
use ros2::{MotionType, Mount};

use super::agent_topic::AgentTopic;
use super::motion_input::MotionSource;

/// Options of the node.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct NodeOptions {
    /// True if the sweeps of the run's vehicles are not offered.
    pub no_points: bool,
    /// Publication of `/clock`.
    pub clock: ClockMode,
    /// Place of the LiDARs on their vehicles; absent: at the origin of the body, and of robots as tf has it.
    pub mount: Option<Mount>,
    /// LiDARs of the ROS 2 network that are those of agents.
    pub lidars: Vec<AgentTopic>,
    /// Motions of these agents in the ROS 2 network.
    pub motions: Vec<MotionSource>,
    /// Poses in the map at which trackers of these agents start.
    pub starting_poses: Vec<AgentTopic>,
    /// Divisor of the intensities that they publish; passed on are 0 to 1.
    pub intensity_scale: IntensityScale,
    /// Vehicle whose first fix is published on `/initialpose`.
    pub initial_pose_of: Option<CavId>,
}

/// Publication of `/clock`, of which a ROS 2 network has one.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum ClockMode {
    /// Published.
    On,
    /// Published if no other node publishes it.
    #[default]
    Unoccupied,
    /// Not published.
    Off,
}

impl NodeOptions {
    /// Vehicles with an odometry: their frames are in a tree of their own.
    pub(super) fn robots(&self) -> impl Iterator<Item = CavId> {
        let motions = self.motions.iter();
        let odometry = motions.filter(|motion| motion.motion_type == MotionType::Odometry);
        odometry.map(|motion| motion.source.cav.clone())
    }
}
