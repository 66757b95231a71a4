//! The ego's side of collaborative perception: views of several CAVs in, boxes around the ego out.
//!
//! - [`ego`]: the pipeline, the same live and offline; [`pairing`] says which messages belong to a frame.
//! - [`model`], [`samples`], [`train`]: how a method learns; [`evaluate`]: what it has learnt.
//! - [`alignment`]: ways to do without GNSS, compared.
//! - [`targets`] and [`loss`]: what a detector is trained towards.
//! - [`warp`] and [`fusion`]: maps of neighbours on the ego's lattice, and many maps made one.
//!
//! Conventions of axes, units and boxes are those of [`protocol`].

#![warn(clippy::print_stdout, clippy::print_stderr)]

pub mod alignment;
pub mod average_precision;
pub mod ego;
pub mod evaluate;
pub mod feature_store;
pub mod fusion;
mod history;
pub mod loss;
#[cfg(test)]
mod made_up;
pub mod method;
pub mod model;
pub mod multi_scale;
mod neighbourhood;
pub mod node;
mod numbers;
pub mod pairing;
mod peer_models;
pub mod residual;
pub mod samples;
pub mod targets;
pub mod train;
pub mod trust;
pub mod warp;

pub use method::{Exchange, Method};
