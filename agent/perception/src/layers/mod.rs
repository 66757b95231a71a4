//! Layers of the detector and of the networks that extend it.

pub mod agent_attention;
pub mod backbone;
pub mod convolution;
pub mod head;
pub mod residual;
pub mod shrink;
