//! Scenes as live traffic: replay, inspection and recording, and the link process between agents and ego.
//!
//! - [`stream`]: publishes the sensor data of a scene at the pace of its capture times, or in lockstep.
//! - [`link_node`]: link emulation between the agents and an ego of a live run.
//! - [`inspect`]: contents and problems of a data set.
//! - [`recorder`]: every message of a run in one MCAP file.
//!
//! ```
//! use sim_replay::inspect::inspect;
//! use simulator::generate::{Subset, SynthOptions, generate};
//!
//! # fn main() -> Result<(), Box<dyn std::error::Error>> {
//! let dir = std::env::temp_dir().join(format!("v2vloc-inspect-{}", std::process::id()));
//! let options = SynthOptions { frames: 1, agents: 2..=2, ..SynthOptions::new(Subset::V2vdet, 1000, dir.clone()) };
//! generate(&options, &|_frames| ())?;
//! let report = inspect(&dir, &Default::default(), &Default::default(), &|_done, _of| ());
//! assert!(report.problems.is_empty());
//! assert_eq!(report.scenarios.len(), 1);
//! # std::fs::remove_dir_all(&dir)?;
//! # Ok(())
//! # }
//! ```

#![warn(clippy::print_stdout, clippy::print_stderr)]

pub mod config;
pub mod inspect;
pub mod link_node;
pub mod recorder;
pub mod stream;
