//! Quantised matrix product.

use tch::{IValue, Result, Tensor};

use super::layer::{Int8Layer, LayerFormat};

/// Number of rows that the library orders the weights for.
const USUAL_ROWS: i64 = 1024;

/// Linear layer of `u8` rows, to `u8` or `f32`.
#[derive(Debug)]
pub struct Int8Linear(Int8Layer);

impl Int8Linear {
    /// Quantises a layer `[C_in, C_out]` with bias `[C_out]`.
    ///
    /// # Errors
    /// Those of the tensor library.
    pub fn new(weight: &Tensor, bias: Option<&Tensor>, format: LayerFormat) -> Result<Self> {
        let inputs = weight.size2()?.0;
        // Integer layers take the transpose.
        let weight = weight.f_tr()?.f_contiguous()?;
        let layer = Int8Layer::new(&weight, bias, format, |operators, quantised| {
            let shape = IValue::IntList(vec![USUAL_ROWS, inputs]);
            let arguments = [IValue::Tensor(quantised.steps.shallow_clone()), shape];
            operators.call("pack_linear", &arguments)
        });
        Ok(Self(layer?))
    }

    /// `[N, C_in]`, `u8`, to `[N, C_out]`.
    ///
    /// # Errors
    /// Those of the tensor library, when `x` has other channels or is not `u8`.
    pub fn forward(&self, x: &Tensor) -> Result<Tensor> {
        self.0.call("multiply", x, Vec::new())
    }
}

#[cfg(test)]
mod tests {
    use tch::{Device, Kind};

    use super::*;
    use crate::int8::scale::{Quantisation, Scale};

    #[test]
    fn products_are_those_of_the_quantised_values() {
        tch::set_num_threads(1);
        tch::manual_seed(3);
        let input = Quantisation {
            scale: Scale::of_exponent(-5),
            zero_point: 128,
        };
        let weight = Tensor::randn([7, 24], (Kind::Float, Device::Cpu)) * 0.2;
        let bias = Tensor::randn([7], (Kind::Float, Device::Cpu));
        let linear = Int8Linear::new(
            &weight.tr(),
            Some(&bias),
            LayerFormat {
                input,
                output: None,
                relu: false,
            },
        )
        .unwrap();
        let x = input
            .quantise(&Tensor::randn([40, 24], (Kind::Float, Device::Cpu)))
            .unwrap();
        let exact = input.dequantise(&x).unwrap().matmul(&weight.tr()) + &bias;
        let found = linear.forward(&x).unwrap();
        // A weight errs by half a step of at most 2^-6, an input is at most 4.
        let off = (&found - &exact).abs().max().double_value(&[]);
        assert!(
            found.kind() == Kind::Float && off > 0.0 && off < 0.1,
            "{off}"
        );
    }
}
