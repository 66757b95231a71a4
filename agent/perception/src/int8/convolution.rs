//! Quantised 2D convolution.

use tch::{IValue, TchError, Tensor};

use super::layer::{Layer, LayerFormat};

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

impl ConvGeometry {
    /// Keeps the size of a map, for an odd kernel.
    #[must_use]
    pub const fn size_preserving(kernel: i64) -> Self {
        Self { stride: 1, padding: kernel / 2, upsampling: 1 }
    }
}

/// Convolution of `u8` maps, channels innermost in memory, to `u8` or `f32`.
#[derive(Debug)]
pub struct Int8Convolution {
    layer: Layer,
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
        let layer = Layer::new(weight, bias, format, |operators, quantised| {
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
        Ok(Self { layer: layer?, geometry })
    }

    /// `[1, C_in, H, W]`, `u8`, to `[1, C_out, H', W']`; channels innermost in memory.
    ///
    /// # Errors
    /// Those of the tensor library, when `x` has other channels or is not `u8`.
    pub fn forward(&self, x: &Tensor) -> Result<Tensor, TchError> {
        let ConvGeometry { stride, padding, upsampling } = self.geometry;
        let y = self.layer.call("convolve", x, vec![both(stride), both(padding)])?;
        if upsampling == 1 { Ok(y) } else { cells_to_squares(&y, upsampling) }
    }
}

fn both(size: i64) -> IValue {
    IValue::IntList(vec![size; 2])
}

/// `[1, edge * edge * C, H, W]`, channels innermost in memory and in the order `[edge, edge, C]`, to
/// `[1, C, edge * H, edge * W]`.
fn cells_to_squares(y: &Tensor, edge: i64) -> Result<Tensor, TchError> {
    let (_, _, height, width) = y.size4()?;
    let cells = y.f_permute([0, 2, 3, 1])?.f_reshape([height, width, edge, edge, -1])?;
    let rows = cells.f_permute([0, 2, 1, 3, 4])?.f_contiguous()?;
    rows.f_view([1, height * edge, width * edge, -1])?.f_permute([0, 3, 1, 2])
}
