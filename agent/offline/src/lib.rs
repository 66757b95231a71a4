//! Offline work on localization: training and evaluation on recorded or generated scenes.
//!
//! - [`training`]: encoder, scene-specific heads and baselines.
//! - [`icp_map`], [`sweep_database`]: what localizers without training start from.
//! - [`mapping`]: a head for a place, from drives through it to its measured accuracy.
//! - [`evaluation`]: errors, confidence and times of a localizer over a data set.
//!
//! The vehicle's process does not link this crate, and with it none of the data-set readers.
//!
//! ```
//! use agent_offline::evaluation::{SweepSelection, evaluate_source};
//! use localization::pose_source::RecordedPose;
//! use simulator::generate::{Subset, SynthOptions, generate};
//!
//! # fn main() -> Result<(), Box<dyn std::error::Error>> {
//! let dir = std::env::temp_dir().join(format!("v2vloc-drive-{}", std::process::id()));
//! generate(&SynthOptions { frames: 2, ..SynthOptions::new(Subset::Town1loc, 1000, dir.clone()) }, &|_frames| ())?;
//! // The pose of the GNSS receiver against the true one.
//! let options = SweepSelection { scenes: vec![dir.clone()], variant: None, every: 1, sweeps: None };
//! let evaluated = evaluate_source(&mut RecordedPose, &options, &mut |_done, _of| ())?;
//! assert_eq!(evaluated.sweeps.len(), 2);
//! # std::fs::remove_dir_all(&dir)?;
//! # Ok(())
//! # }
//! ```

#![warn(clippy::print_stdout, clippy::print_stderr)]

mod drive_frames;
mod error;
pub mod evaluation;
pub mod icp_map;
pub mod mapping;
pub mod sweep_database;
pub mod training;
mod training_bar;

pub use error::Error;
pub(crate) use error::Result;
pub use training_bar::TrainingBar;
