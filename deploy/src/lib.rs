//! Operator's tool: runs and supervises the processes of a fleet, scores what they publish and shows it. Computes no
//! network, and links no libtorch.
//!
//! - [`score`]: live comparison of detections with ground truth, and message accounting.
//! - [`operate`]: processes, network, keys, health, the run folder.
//! - [`report`]: pace, latency, stages and resources of a run that has ended.
//! - [`view`]: a page that shows a run, live or recorded.
//! - [`ros`]: node of a ROS 2 network.
//!
//! `operate` uses `score`; `report` and `view` use both, `ros` none.
//!
//! ```
//! use deploy::operate::status::RunStatus;
//!
//! let folder = std::env::temp_dir().join(format!("v2vloc-runs-{}", std::process::id()));
//! let error = RunStatus::newest(&folder).unwrap_err();
//! assert_eq!(error.to_string(), format!("there is no run in {}", folder.display()));
//! ```

#![warn(clippy::print_stdout, clippy::print_stderr)]

mod command;
pub mod command_line;
pub mod operate;
pub mod report;
pub mod ros;
pub mod score;
pub mod view;
