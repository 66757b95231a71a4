//! Perception of one vehicle: a LiDAR detector on pillars, its layers, boxes, weights and training loop.
//!
//! - [`pillars`], [`layers`], [`detector`]: point cloud to BEV feature map to boxes.
//! - [`boxes`]: anchors, decoding, non-maximum suppression and post-processing.
//! - [`int8`]: the same layers in 8-bit integers, for inference.
//! - [`sparse`]: sparse convolution, for the scene encoder of the localization.
//! - [`weights`], [`model_config`]: checkpoints and the sizes of a model.
//! - [`compute_device`], [`compute_precision`]: where and in which number format networks compute.
//! - `train`, with the feature of that name: optimiser, schedule, checkpoints and progress of every training.
//!
//! Tensors are `[N, C, H, W]`; the row of a BEV feature map grows with y, the column with x.
//!
//! ```
//! use perception::detector::Detector;
//! use perception::model_config::DetectorConfig;
//! use perception::pillars::point_pillars::PointPillars;
//! use tch::{Device, nn::VarStore};
//!
//! # fn main() -> Result<(), perception::model_config::ConfigError> {
//! // An untrained network of the released sizes.
//! let variables = VarStore::new(Device::Cpu);
//! let detector = Detector::from_network(PointPillars::new(&variables.root(), &DetectorConfig::lean())?);
//! let grid = detector.grid();
//! assert_eq!((grid.width, grid.height, grid.cell_m), (128, 96, 0.8));
//! # Ok(())
//! # }
//! ```

#![warn(clippy::print_stdout, clippy::print_stderr)]

pub mod boxes;
pub mod compute_device;
pub mod compute_precision;
pub mod crop;
pub mod detector;
pub mod inference;
pub mod int8;
pub mod layers;
pub mod model_config;
pub mod pillars;
pub mod sparse;
pub mod tensor_values;
pub mod torch_error;
#[cfg(feature = "train")]
pub mod train;
pub mod weights;
