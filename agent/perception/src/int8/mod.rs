//! 8-bit inference: convolutions and matrix products in integers, by the quantised operators of oneDNN.
//!
//! Activations are `u8`, weights `s8` within ±[`MAX_WEIGHT`], sums 32 bits wide. Two rules make the result the same
//! on every processor. All scales are powers of two, so that scaling rounds nothing and the order of operations does not
//! matter. Weights have seven bits, because processors without VNNI add two products in 16 bits, which eight bits would
//! saturate. `f32` biases are added to the scaled sum.
//!
//! Scales of activations are found once on a few sweeps ([`ScaleSearch`]) and stored in the metadata of the weights
//! file ([`ActivationScales`]); its parameters stay in floating point.

mod activation_scales;
mod convolution;
mod error;
mod layer;
mod linear;
mod operators;
mod precision;
mod scale;
mod scale_search;
mod weight;

pub use activation_scales::{ActivationScales, SCALES_KEY};
pub use convolution::{ConvGeometry, Int8Convolution};
pub use error::QuantiseError;
pub use layer::LayerFormat;
pub use linear::Int8Linear;
pub use precision::InferencePrecision;
pub use scale::{Quantisation, Scale};
pub use scale_search::ScaleSearch;
pub use weight::MAX_WEIGHT;
