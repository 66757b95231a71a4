//! Scene simulator: road maps, traffic, sensors and weather of generated scenes.
//!
//! - [`map`]: generated towns and OpenDRIVE maps as roads, lanes, ground and solids.
//! - [`generate`]: vehicles, LiDAR, radar, weather and the files of a scene, deterministic in the seed.

#![warn(clippy::print_stdout, clippy::print_stderr)]

pub mod generate;
pub mod map;
