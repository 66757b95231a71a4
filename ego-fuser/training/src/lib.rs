//! Training of the cooperative detector: samples, targets, losses and the loop.
//!
//! - [`samples`]: what a training step sees, built from scenes.
//! - [`loss`], [`train`]: the loss and the loop around it.
//! - [`feature_store`]: BEV feature maps that are computed once.

#![warn(clippy::print_stdout, clippy::print_stderr)]

mod error;
pub mod feature_store;
pub mod loss;
pub mod samples;
pub mod train;

pub use error::Error;
pub(crate) use error::Result;
