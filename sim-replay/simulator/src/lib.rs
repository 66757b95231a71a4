//! Scene simulator: road maps, traffic, sensors and weather of generated scenes.
//!
//! - [`map`]: generated towns and OpenDRIVE maps as roads, lanes, ground and solids.
//! - [`generate`]: vehicles, LiDAR, radar, weather and the files of a scene, deterministic in the seed.
//!
//! ```
//! use simulator::generate::{Subset, SynthOptions, generate};
//!
//! # fn main() -> Result<(), Box<dyn std::error::Error>> {
//! let out = std::env::temp_dir().join(format!("v2vloc-scene-{}", std::process::id()));
//! let options = SynthOptions { frames: 1, agents: 2..=2, ..SynthOptions::new(Subset::V2vdet, 1000, out.clone()) };
//! generate(&options, &|_frames| ())?;
//! assert!(out.read_dir()?.next().is_some()); // a folder for the scenario
//! # std::fs::remove_dir_all(&out)?;
//! # Ok(())
//! # }
//! ```

#![warn(clippy::print_stdout, clippy::print_stderr)]

pub mod generate;
pub mod map;
