//! Scene generation: traffic on a map, and the sensors of its vehicles.
//!
//! [`generate`] writes scenes in a [`SceneLayout`], by default OPV2V's, and the readers of `dataset` read them like any
//! other data set. [`convert`] writes an opened data set in such a layout. The stages, in order: a static
//! [`crate::map`], parked vehicles, traffic that is recorded step by step, then for each agent and frame the [`lidar`],
//! the [`radar`], the cameras and the receivers, all of them over one ray caster ([`raycast`]), and the writer of the layout.
//!
//! ```no_run
//! use simulator::generate::{Subset, SynthOptions, generate};
//!
//! # fn main() -> Result<(), simulator::generate::SynthError> {
//! let options = SynthOptions { scenes: 2, ..SynthOptions::new(Subset::V2vdet, 7, "scenes".into()) };
//! let summary = generate(&options, &|_| {})?;
//! println!("{} frames", summary.agent_frames);
//! # Ok(())
//! # }
//! ```

mod cache;
mod camera;
mod convert;
mod data_protocol;
mod error;
pub(crate) mod layout;
pub mod lidar;
mod options;
mod parking;
mod positioning;
pub mod radar;
pub mod raycast;
mod recording;
mod scenes;
mod sensing;
mod terrain;
mod traffic;
pub mod vehicle;
pub mod weather;
mod world;

pub use cache::{are_kept, generate_whole};
pub use camera::ImageSize;
pub use convert::{Converted, convert};
pub(crate) use error::Result;
pub use error::SynthError;
pub use layout::SceneLayout;
pub use options::{Subset, SynthOptions};
pub use scenes::{Summary, generate};
pub use weather::Weather;
pub use world::ground_surface;
