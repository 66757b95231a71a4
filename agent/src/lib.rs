//! Agent of one connected vehicle: pose and BEV features of each of its sweeps, published on the bus.
//!
//! - [`agent`]: the pipeline, synchronous and without a network; [`agent_output`]: what it finds in one sweep;
//!   [`agent_loop`]: its decisions; [`node`]: the process around it. [`input_log`] and [`loop_clock`]: what the processes of loops share.
//! - [`rate`]: bytes per message under a byte budget; `sweep_pairing`: sweep and starting pose of one capture time.
//! - [`attack`]: falsified messages, for experiments on misbehaviour detection.
//!
//! ```
//! use agent::agent::{Agent, AgentInput};
//! use localization::pose_source::RecordedPose;
//! use perception::detector::Detector;
//! use perception::model_config::DetectorConfig;
//! use perception::pillars::point_pillars::PointPillars;
//! use protocol::{CavId, EgoMotion, PointCloud, Pose};
//! use tch::{Device, nn::VarStore};
//!
//! # fn main() -> Result<(), Box<dyn std::error::Error>> {
//! // One vehicle with an untrained network and the recorded pose.
//! let variables = VarStore::new(Device::Cpu);
//! let detector = Detector::from_network(PointPillars::new(&variables.root(), &DetectorConfig::lean())?);
//! let mut agent = Agent::new(CavId::new("4279")?, Box::new(RecordedPose), detector);
//! let cloud = PointCloud { xyzi: vec![[10.0, 2.0, -1.0, 0.5]; 100] };
//! let pose = Pose::from_xyz_yaw([12.0, -3.5, 1.9], 0.3);
//! let input = AgentInput { capture_nanos: 0, cloud: &cloud, measured_pose: Some(&pose), motion: EgoMotion::default() };
//! let output = agent.process(&input)?;
//! assert_eq!(output.perception.features.grid.width, 128);
//! # Ok(())
//! # }
//! ```

#![warn(clippy::print_stdout, clippy::print_stderr)]

pub mod agent;
pub mod agent_loop;
pub mod agent_output;
pub mod attack;
mod command;
pub mod command_line;
pub mod config;
pub mod input_log;
pub mod loop_clock;
pub mod node;
pub mod rate;
pub(crate) mod sweep_pairing;
pub(crate) mod sweep_selection;
