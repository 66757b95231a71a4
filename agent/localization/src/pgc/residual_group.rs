//! Residual group of sparse convolutions, in floating point and in 8-bit integers.

use tch::Tensor;
use tch::nn::{self, Init};

use super::dense::Dense;
use perception::int8::{ActivationScales, Int8Linear, LayerFormat, Quantisation, QuantiseError};
use perception::sparse::{GatherIndex, Int8SparseConv, SparseConv};

/// Called with the name and the values of an activation.
pub(super) type OnActivation<'a> = dyn FnMut(&str, &Tensor) -> tch::Result<()> + 'a;

/// Two 3x3x3 convolutions with a 1x1 one between them, and a skip connection.
#[derive(Debug)]
pub(super) struct ResidualGroup {
    inward: SparseConv,
    middle: Dense,
    outward: SparseConv,
    /// `[C_in, C_out]`; `None` if both are the same.
    skip: Option<Tensor>,
}

/// A residual group in integers.
#[derive(Debug)]
pub(super) struct Int8ResidualGroup {
    input: Quantisation,
    inward: Int8SparseConv,
    middle: Int8Linear,
    outward: Int8SparseConv,
    skip: Option<Int8Linear>,
}

impl ResidualGroup {
    pub(super) fn new(path: &nn::Path<'_>, inputs: i64, outputs: i64) -> Self {
        let stdev = (2.0 / inputs as f64).sqrt();
        let random = Init::Randn { mean: 0.0, stdev };
        Self {
            inward: SparseConv::new(&(path / "inward"), inputs, outputs),
            middle: Dense::new(&(path / "middle"), outputs, outputs, 1.0),
            outward: SparseConv::new(&(path / "outward"), outputs, outputs),
            skip: (inputs != outputs)
                .then(|| (path / "skip").var("weight", &[inputs, outputs], random)),
        }
    }

    /// `[N, C_in]` to `[N, C_out]`, not negative. `on_activation` gets those within, below `name`.
    pub(super) fn forward(
        &self,
        x: &Tensor,
        index: &GatherIndex,
        name: &str,
        on_activation: &mut OnActivation<'_>,
    ) -> tch::Result<Tensor> {
        let inner = self.inward.forward(x, index)?.f_relu()?;
        on_activation(&activation(name, "inward"), &inner)?;
        let inner = self.middle.forward(&inner)?.f_relu()?;
        on_activation(&activation(name, "middle"), &inner)?;
        let inner = self.outward.forward(&inner, index)?;
        match &self.skip {
            Some(skip) => (inner + x.f_matmul(&skip.to_kind(x.kind()))?).f_relu(),
            None => (inner + x).f_relu(),
        }
    }

    /// The same in integers, its activations below `name`.
    pub(super) fn int8(
        &self,
        input: Quantisation,
        name: &str,
        scales: &ActivationScales,
    ) -> Result<Int8ResidualGroup, QuantiseError> {
        let inward = scales.get(&activation(name, "inward"))?;
        let middle = scales.get(&activation(name, "middle"))?;
        let skip = self.skip.as_ref();
        let skip = skip.map(|skip| Int8Linear::new(skip, None, LayerFormat::last(input)));
        Ok(Int8ResidualGroup {
            input,
            inward: self.inward.int8(LayerFormat::hidden(input, inward))?,
            middle: self.middle.int8(LayerFormat::hidden(inward, middle))?,
            outward: self.outward.int8(LayerFormat::last(middle))?,
            skip: skip.transpose()?,
        })
    }
}

impl Int8ResidualGroup {
    /// `[N, C_in]`, `u8`, to `[N, C_out]`, `f32` and not negative.
    pub(super) fn forward(&self, x: &Tensor, index: &GatherIndex) -> tch::Result<Tensor> {
        let inner = self.middle.forward(&self.inward.forward(x, index)?)?;
        let skipped = match &self.skip {
            Some(skip) => skip.forward(x)?,
            None => self.input.dequantise(x)?,
        };
        let mut outer = self.outward.forward(&inner, index)?;
        outer.f_add_(&skipped)?.f_relu_()
    }
}

fn activation(name: &str, layer: &str) -> String {
    format!("{name}.{layer}")
}
