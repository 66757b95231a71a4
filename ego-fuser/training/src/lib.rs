//! Training of the cooperative detector: samples, targets, losses, the loop and average precision.
//!
//! - [`samples`]: what a training step sees, built from scenes.
//! - [`loss`], [`train`]: the loss and the loop around it.
//! - [`feature_store`]: BEV feature maps that are computed once.
//! - [`average_precision`]: the metric, as OpenCOOD computes it and per frame.
//!
//! ```
//! use protocol::{Box3d, Detection};
//! use training::average_precision::{Ordering, Scorer};
//!
//! let car = Box3d { center_m: [10.0, 2.0, -1.0], size_m: [4.5, 1.9, 1.6], heading_rad: 0.1 };
//! let mut scorer = Scorer::new(&[0.5, 0.7]);
//! scorer.add(&[Detection { box3d: car.clone(), score: 0.9, source: None }], &[car]);
//! assert_eq!(scorer.average_precisions(Ordering::Global), [1.0, 1.0]);
//! ```

#![warn(clippy::print_stdout, clippy::print_stderr)]

pub mod average_precision;
pub mod feature_store;
pub mod loss;
pub mod samples;
mod sweep_encoder;
pub mod train;
