//! Operator's tool: starts and supervises a fleet, runs experiments on it and shows it.
//!
//! - [`scenario`]: the file that describes a run; weights and hashes of its inputs.
//! - [`score`]: live comparison of detections with ground truth, and message accounting.
//! - [`operate`]: processes, network, keys, health, the run folder.
//! - [`run`]: one run, live or in simulation time, and its metrics.
//! - [`experiment`]: offline evaluation, tables, sweeps and reports.
//! - [`ros`]: node of a ROS 2 network.
//! - [`view`]: a page that shows a run, live or recorded, and its pictures.
//!
//! Each uses those before it in this list only; `view` uses `operate` and `score`, `ros` none.
//!
//! ```
//! use deploy::scenario::Scenario;
//!
//! # fn main() -> Result<(), deploy::scenario::ScenarioError> {
//! let scenario = Scenario::read("scenarios/demo.yaml".as_ref())?;
//! assert_eq!(scenario.method.name(), "max");
//! # Ok(())
//! # }
//! ```

#![warn(clippy::print_stdout, clippy::print_stderr)]

pub mod experiment;
pub mod operate;
pub mod ros;
pub mod run;
pub mod scenario;
pub mod schema;
pub mod score;
pub mod view;
