//! Residual block of the scene head in 8-bit integers.
//!
//! The first and the last layer of the head stay in floating point: some normalised features are many deviations from
//! zero, and errors of the last layer are the same for all cells, so that they are errors of the pose.

use tch::Tensor;

use perception::int8::{Int8Linear, Quantisation};

/// Three layers and a skip connection.
#[derive(Debug)]
pub(super) struct Int8Block {
    pub(super) input: Quantisation,
    pub(super) layers: [Int8Linear; 3],
}

impl Int8Block {
    /// `[N, width]` to `[N, width]`, both `f32` and not negative.
    pub(super) fn forward(&self, x: &Tensor) -> tch::Result<Tensor> {
        let [first, second, third] = &self.layers;
        let inner = third.forward(&second.forward(&first.forward(&self.input.quantise(x)?)?)?)?;
        inner.f_add(x)?.f_relu_()
    }
}
