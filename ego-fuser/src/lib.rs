//! The ego's side of collaborative perception: views of several CAVs in, boxes around the ego out.
//!
//! - [`targets`] and [`loss`]: what a detector is trained towards.
//! - [`warp`] and [`fusion`]: maps of neighbours on the ego's lattice, and many maps made one.
//!
//! Conventions of axes, units and boxes are those of [`protocol`].

pub mod average_precision;
pub mod fusion;
pub mod loss;
pub mod method;
pub mod model;
pub mod samples;
pub mod targets;
pub mod train;
pub mod warp;

pub use method::{Exchange, Method};
