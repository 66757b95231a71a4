//! Offline work on localization: training and evaluation on recorded or generated scenes.
//!
//! - [`training`]: encoder, scene-specific heads and end-to-end networks.
//! - [`mapping`]: a head for a place, from drives through it to its measured accuracy.
//! - [`evaluation`]: errors, confidence and times of a localizer over a data set.
//!
//! The vehicle's process does not link this crate, and with it none of the data-set readers.

#![warn(clippy::print_stdout, clippy::print_stderr)]

pub mod evaluation;
pub mod head_files;
pub mod icp_map;
pub mod mapping;
pub mod training;
