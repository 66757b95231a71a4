//! Scene generation: traffic in a town, and the sensors of the vehicles in it.
//!
//! [`generate`] writes scenes in a [`SceneLayout`], by default OPV2V's, and the readers of this crate read them back like
//! any other dataset. [`convert`] writes a dataset that was opened in such a layout.
//! The parts, in the order in which they work: a [`crate::town`] that stands still, parked vehicles, traffic that is
//! recorded step by step, then for each agent and frame the [`lidar`], the [`radar`] and the receivers, all of them over
//! one ray [`cast`]er, and the writer of the layout.
//!
//! ```no_run
//! use sim_replay::synth::{Subset, SynthOptions, generate};
//!
//! # fn main() -> Result<(), sim_replay::synth::SynthError> {
//! let options = SynthOptions { scenes: 2, ..SynthOptions::new(Subset::V2vdet, 7, "scenes".into()) };
//! let summary = generate(&options, &|_| {})?;
//! println!("{} frames", summary.agent_frames);
//! # Ok(())
//! # }
//! ```

pub mod cast;
mod convert;
mod error;
mod generate;
mod kept;
pub(crate) mod layout;
pub mod lidar;
mod options;
mod parking;
mod positioning;
mod protocol_file;
pub mod radar;
mod recording;
mod sensing;
mod terrain;
mod traffic;
pub mod vehicle;
pub mod weather;
mod world;

pub use convert::{ConvertOptions, Converted, convert};
pub use error::SynthError;
pub use generate::{Summary, generate};
pub use kept::{are_kept, generate_whole};
pub use layout::SceneLayout;
pub use options::{Subset, SynthOptions};
pub use weather::Weather;
pub use world::ground_surface;
