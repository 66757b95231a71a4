//! Training of the cooperative detector: samples, targets, losses, the loop and average precision.
//!
//! - [`samples`]: what a training step sees, built from scenes.
//! - [`loss`], [`train`]: the loss and the loop around it.
//! - [`feature_store`]: BEV feature maps that are computed once.
//! - [`average_precision`]: the metric, as OpenCOOD computes it and per frame.

#![warn(clippy::print_stdout, clippy::print_stderr)]

pub mod average_precision;
pub mod feature_store;
pub mod loss;
pub mod samples;
pub mod train;
