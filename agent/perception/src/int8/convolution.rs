//! Quantised 2D convolution.

use tch::{IValue, TchError, Tensor};

use super::layer::{Int8Layer, LayerFormat};

/// Map size `[H, W]` that the library orders the weights for.
const USUAL_MAP: [i64; 2] = [96, 128];

/// Geometry of a convolution.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct ConvGeometry {
    /// Step of the kernel, cells.
    pub stride: i64,
    /// Zero padding on every side, cells.
    pub padding: i64,
    /// Edge of the square of cells that one cell becomes: more than 1 for a transposed convolution whose kernel is its
    /// stride, written as a convolution with output channels `[edge, edge, C_out]`.
    pub upsampling: i64,
}

/// Convolution of `u8` maps, channels innermost in memory, to `u8` or `f32`.
#[derive(Debug)]
pub struct Int8Convolution {
    layer: Int8Layer,
    geometry: ConvGeometry,
}

impl Int8Convolution {
    /// Quantises a convolution with weight `[C_out, C_in, k, k]` and bias `[C_out]`.
    ///
    /// # Errors
    /// Those of the tensor library.
    pub fn new(
        weight: &Tensor,
        bias: Option<&Tensor>,
        geometry: ConvGeometry,
        format: LayerFormat,
    ) -> Result<Self, TchError> {
        let inputs = weight.size4()?.1;
        let layer = Int8Layer::new(weight, bias, format, |operators, quantised| {
            let [height, width] = USUAL_MAP;
            let arguments = [
                IValue::Tensor(quantised.steps.shallow_clone()),
                IValue::Tensor(quantised.scales.shallow_clone()),
                IValue::Double(format.input.scale.step()),
                IValue::Int(i64::from(format.input.zero_point)),
                both(geometry.stride),
                both(geometry.padding),
                IValue::IntList(vec![1, inputs, height, width]),
            ];
            operators.call("pack_convolution", &arguments)
        });
        let layer = layer?;
        Ok(Self { layer, geometry })
    }

    /// `[1, C_in, H, W]`, `u8`, to `[1, C_out, H', W']`; channels innermost in memory.
    ///
    /// # Errors
    /// Those of the tensor library, when `x` has other channels or is not `u8`.
    pub fn forward(&self, x: &Tensor) -> Result<Tensor, TchError> {
        let (stride, padding) = (self.geometry.stride, self.geometry.padding);
        let steps = vec![both(stride), both(padding)];
        let y = self.layer.call("convolve", x, steps)?;
        match self.geometry.upsampling {
            1 => Ok(y),
            edge => cells_to_squares(&y, edge),
        }
    }
}

fn both(size: i64) -> IValue {
    IValue::IntList(vec![size; 2])
}

/// `[1, edge * edge * C, H, W]`, channels innermost in memory and in the order `[edge, edge, C]`, to
/// `[1, C, edge * H, edge * W]`.
fn cells_to_squares(y: &Tensor, edge: i64) -> Result<Tensor, TchError> {
    let (_, _, height, width) = y.size4()?;
    let cells = y.f_permute([0, 2, 3, 1])?;
    let cells = cells.f_reshape([height, width, edge, edge, -1])?;
    // From `[H, W, row, column, C]` to `[H, row, W, column, C]`: the rows of the up-sampled map.
    let rows = cells.f_permute([0, 2, 1, 3, 4])?.f_contiguous()?;
    let map = rows.f_view([1, height * edge, width * edge, -1])?;
    map.f_permute([0, 3, 1, 2])
}

#[cfg(test)]
mod tests {
    use protocol::text::hex;
    use sha2::{Digest, Sha256};
    use tch::{Device, Kind};

    use super::*;
    use crate::int8::{Quantisation, Scale};

    const INPUT: Quantisation = Quantisation {
        scale: Scale::of_exponent(-4),
        zero_point: 100,
    };

    fn channels_last(x: &Tensor) -> Tensor {
        x.permute([0, 2, 3, 1]).contiguous().permute([0, 3, 1, 2])
    }

    #[test]
    fn convolutions_are_close_to_those_in_floating_point() {
        tch::set_num_threads(1);
        tch::manual_seed(5);
        // Within the range of the input: other tests draw from the same generator, so no seed keeps values from its ends.
        let x = Tensor::rand([1, 12, 9, 7], (Kind::Float, Device::Cpu)) * 12.0 - 6.0;
        let x = channels_last(&x);
        let weight = Tensor::randn([20, 12, 3, 3], (Kind::Float, Device::Cpu)) * 0.1;
        let bias = Tensor::randn([20], (Kind::Float, Device::Cpu));
        for (stride, relu) in [(1, true), (2, false)] {
            let geometry = ConvGeometry {
                stride,
                padding: 1,
                upsampling: 1,
            };
            let format = LayerFormat {
                input: INPUT,
                output: None,
                relu,
            };
            let convolution = Int8Convolution::new(&weight, Some(&bias), geometry, format).unwrap();
            let expected = x.conv2d(&weight, Some(&bias), [stride; 2], [1; 2], [1; 2], 1);
            let expected = if relu { expected.relu() } else { expected };
            let found = convolution.forward(&INPUT.quantise(&x).unwrap()).unwrap();
            let error = (&found - &expected)
                .square()
                .mean(Kind::Float)
                .sqrt()
                .double_value(&[]);
            assert!(
                error < 0.03 * expected.std(true).double_value(&[]),
                "stride {stride}: {error}"
            );
        }
    }

    #[test]
    fn each_cell_becomes_a_square() {
        let y =
            channels_last(&Tensor::arange(2 * 8, (Kind::Float, Device::Cpu)).view([1, 8, 1, 2]));
        let squares = cells_to_squares(&y, 2).unwrap();
        assert_eq!(squares.size(), [1, 2, 2, 4]);
        // Channel (row, column, c) of cell x is channel c at that row and column of its square.
        let expected = [0.0, 4.0, 1.0, 5.0, 8.0, 12.0, 9.0, 13.0_f32];
        assert_eq!(
            Vec::<f32>::try_from(squares.get(0).get(0).contiguous().view([-1])).unwrap(),
            expected
        );
    }

    /// Numbers that are the same everywhere, -1 to 1.
    fn numbers(seed: u64, shape: &[i64]) -> Tensor {
        let count: i64 = shape.iter().product();
        let mut state = seed;
        let values: Vec<f32> = (0..count)
            .map(|_| {
                state = state
                    .wrapping_mul(6_364_136_223_846_793_005)
                    .wrapping_add(1_442_695_040_888_963_407);
                (state >> 40) as f32 / (1_u64 << 23) as f32 - 1.0
            })
            .collect();
        Tensor::from_slice(&values).view(shape)
    }

    /// Whatever instructions the processor has: this test passes on all or the rules of the module are broken.
    #[test]
    fn the_bytes_are_the_same_on_every_processor() {
        tch::set_num_threads(1);
        let x = channels_last(&(numbers(1, &[1, 64, 40, 56]) * 6.0));
        let (weight, bias) = (numbers(2, &[96, 64, 3, 3]) * 0.3, numbers(3, &[96]));
        let format = LayerFormat {
            input: INPUT,
            output: Some(Scale::of_exponent(-3)),
            relu: true,
        };
        let convolution = Int8Convolution::new(
            &weight,
            Some(&bias),
            ConvGeometry {
                stride: 1,
                padding: 1,
                upsampling: 1,
            },
            format,
        )
        .unwrap();
        let y = convolution.forward(&INPUT.quantise(&x).unwrap()).unwrap();
        let bytes = Vec::<u8>::try_from(y.contiguous().view([-1])).unwrap();
        let levels = bytes
            .iter()
            .collect::<std::collections::BTreeSet<_>>()
            .len();
        assert!(levels > 200, "{levels} levels");
        assert_eq!(
            hex(&Sha256::digest(&bytes)),
            "af7a5b847f2772172a998e20696873a84b22d9de7cd375bd8641674871fab22e"
        );
    }
}
