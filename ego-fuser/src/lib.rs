//! Ego of a collaborating fleet: received BEV feature maps, poses and boxes in, detections around the ego out.
//!
//! - [`ego`]: the pipeline; [`ego_loop`]: its decisions, the same live and offline; [`node`]: the process around it.
//! - [`pairing`]: the messages that belong to a frame; [`silence`]: the neighbours that it waits for; [`capture_clock`]:
//!   neighbours whose capture times differ.
//! - [`misbehaviour`]: neighbours whose messages contradict the ego's perception.
//!
//! Conventions of axes, units and boxes are those of [`protocol`].
//!
//! ```
//! use ego_fuser::pairing::{Pairing, PairingConfig};
//! use protocol::CavId;
//!
//! # fn main() -> Result<(), protocol::IdError> {
//! // A neighbour's map of 100 ms before is fused with the ego's frame, with its age.
//! let neighbour = CavId::new("4288")?;
//! let mut pairing = Pairing::new(PairingConfig::with_max_age_nanos(150_000_000));
//! assert!(pairing.insert(&neighbour, 900_000_000, "map").is_none());
//! let (paired, dropped) = pairing.pair(1_000_000_000);
//! assert_eq!((*paired[0].message, paired[0].age_nanos), ("map", 100_000_000));
//! assert!(dropped.is_empty());
//! # Ok(())
//! # }
//! ```

#![warn(clippy::print_stdout, clippy::print_stderr)]

pub mod capture_clock;
mod command;
pub mod command_line;
pub mod config;
pub mod ego;
pub mod ego_loop;
pub mod misbehaviour;
mod neighbourhood;
pub mod node;
pub(crate) mod pace_control;
pub mod pairing;
mod peer_models;
pub mod silence;
pub mod view;
