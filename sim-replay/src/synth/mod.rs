//! Scene generation: traffic in a town, and the sensors of the vehicles in it.
//!
//! [`generate`] writes scenes in the layout of OPV2V, which the readers of this crate read back like any other dataset.
//! The parts, in the order in which they work: a [`crate::town`] that stands still, parked vehicles, traffic that is
//! recorded step by step, then for each agent and frame the [`lidar`], the [`radar`] and the receivers, all of them over
//! one ray [`cast`]er, and the writer.
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
mod error;
mod generate;
mod kept;
pub mod lidar;
mod options;
mod parking;
mod positioning;
mod protocol_file;
pub mod radar;
mod recording;
mod terrain;
mod traffic;
pub mod vehicle;
pub mod weather;
mod world;
mod writer;

pub use error::SynthError;
pub use generate::{Summary, generate};
pub use kept::{are_kept, generate_whole};
pub use options::{Subset, SynthOptions};
pub use weather::Weather;
pub use world::ground_surface;
