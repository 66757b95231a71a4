//! Parameters of a quantised layer and its call.

use tch::{IValue, Kind, Result, Tensor};

use super::operators::Operators;
use super::scale::{Quantisation, Scale};
use super::weight::QuantisedWeight;

/// Number of `u8` in libtorch's list of types.
const U8: i64 = 0;
/// Number of `f32` in it.
const F32: i64 = 6;

/// Input and output of a quantised layer.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct LayerFormat {
    /// Quantisation of the `u8` input.
    pub input: Quantisation,
    /// Scale of `u8` results, which are never negative; without one they are `f32`.
    pub output: Option<Scale>,
    /// A ReLU at the end.
    pub relu: bool,
}

impl LayerFormat {
    /// A layer with a ReLU, whose results are quantised for the next one.
    pub fn hidden(input: Quantisation, output: Quantisation) -> Self {
        Self {
            input,
            output: Some(output.scale),
            relu: true,
        }
    }

    /// A layer without a ReLU, whose results are in floating point.
    pub fn last(input: Quantisation) -> Self {
        Self {
            input,
            output: None,
            relu: false,
        }
    }
}

/// Weight, bias and format of a layer.
#[derive(Debug)]
pub(super) struct Int8Layer {
    packed: Tensor,
    quantised: QuantisedWeight,
    bias: Option<Tensor>,
    format: LayerFormat,
}

impl Int8Layer {
    /// Quantises a weight `[C_out, ...]` with bias `[C_out]`; `pack` brings the quantised one into the order of the
    /// operator.
    pub(super) fn new(
        weight: &Tensor,
        bias: Option<&Tensor>,
        format: LayerFormat,
        pack: impl FnOnce(&Operators, &QuantisedWeight) -> Result<Tensor>,
    ) -> Result<Self> {
        let quantised = QuantisedWeight::new(weight)?;
        let packed = pack(Operators::get()?, &quantised)?;
        let bias = bias.map(|bias| bias.f_to_kind(Kind::Float)).transpose()?;
        Ok(Self {
            packed,
            quantised,
            bias,
            format,
        })
    }

    /// Calls an operator with this layer's parameters, followed by others of the operator.
    pub(super) fn call(&self, operator: &str, x: &Tensor, others: Vec<IValue>) -> Result<Tensor> {
        let (input, output, relu) = (self.format.input, self.format.output, self.format.relu);
        let mut arguments = vec![
            tensor(x),
            IValue::Double(input.scale.step()),
            IValue::Int(i64::from(input.zero_point)),
            tensor(&self.packed),
            tensor(&self.quantised.scales),
            tensor(&self.quantised.zero_points),
            self.bias.as_ref().map_or(IValue::None, tensor),
            // An output scale of 1 leaves `f32` results as they are.
            IValue::Double(output.map_or(1.0, Scale::step)),
            IValue::Int(if output.is_some() { U8 } else { F32 }),
            IValue::String(if relu { "relu" } else { "none" }.to_owned()),
        ];
        arguments.extend(others);
        Operators::get()?.call(operator, &arguments)
    }
}

fn tensor(tensor: &Tensor) -> IValue {
    IValue::Tensor(tensor.shallow_clone())
}
