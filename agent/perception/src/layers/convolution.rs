//! 2D convolution layer with batch norm and ReLU.

use tch::nn::{self, Init};
use tch::{TchError, Tensor};

use crate::int8::{ConvGeometry, Int8Convolution, LayerFormat, Quantisation, Scale};

/// Epsilon of every batch norm of PointPillars.
const NORM_EPS: f64 = 1e-3;
/// Weight of a new batch in the running statistics of PointPillars.
const NORM_MOMENTUM: f64 = 0.01;

/// Batch norm over `channels` with the parameter names of the reference.
///
/// `path` holds `weight`, `bias`, `running_mean`, `running_var`.
#[derive(Debug)]
pub struct Norm {
    weight: Tensor,
    /// Learnt shift `[C]`.
    pub(crate) bias: Tensor,
    running_mean: Tensor,
    running_var: Tensor,
    eps: f64,
    momentum: f64,
}

impl Norm {
    /// A batch norm that is the identity until it is trained; epsilon and momentum are those of PointPillars.
    pub fn new(path: &nn::Path<'_>, channels: i64) -> Self {
        Self::with_eps(path, channels, NORM_EPS, NORM_MOMENTUM)
    }

    /// A batch norm with the epsilon and momentum that PyTorch has by default.
    pub fn with_defaults(path: &nn::Path<'_>, channels: i64) -> Self {
        Self::with_eps(path, channels, 1e-5, 0.1)
    }

    /// A batch norm with another epsilon and momentum.
    pub fn with_eps(path: &nn::Path<'_>, channels: i64, eps: f64, momentum: f64) -> Self {
        Self {
            weight: path.var("weight", &[channels], Init::Const(1.0)),
            bias: path.var("bias", &[channels], Init::Const(0.0)),
            running_mean: path.zeros_no_train("running_mean", &[channels]),
            running_var: path.ones_no_train("running_var", &[channels]),
            eps,
            momentum,
        }
    }

    /// Normalises `[N, C]` or `[N, C, H, W]`; with `train` by the statistics of this batch, which update the running
    /// ones.
    pub fn forward(&self, x: &Tensor, train: bool) -> Tensor {
        let (weight, bias) = (Some(&self.weight), Some(&self.bias));
        let (mean, var) = (Some(&self.running_mean), Some(&self.running_var));
        let (momentum, eps) = (self.momentum, self.eps);
        x.batch_norm(weight, bias, mean, var, train, momentum, eps, true)
    }

    /// The norm with its running statistics as `x * scale + shift`, both `[C]`.
    pub(crate) fn scale_shift(&self) -> (Tensor, Tensor) {
        // weight * (x - mean) / sqrt(var + eps) + bias, written as a line in x.
        let scale = &self.weight / (&self.running_var + self.eps).sqrt();
        let shift = &self.bias - &self.running_mean * &scale;
        (scale, shift)
    }
}

/// Direction of a convolution.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum ConvDirection {
    /// `[out, in, k, k]` weights.
    Down,
    /// Transposed: `[in, out, k, k]` weights.
    Up,
}

/// Convolution with optional batch norm and ReLU.
#[derive(Debug)]
pub struct ConvLayer {
    weight: Tensor,
    bias: Option<Tensor>,
    stride: i64,
    padding: i64,
    direction: ConvDirection,
    norm: Option<Norm>,
    relu: bool,
}

impl ConvLayer {
    /// `kernel x kernel` convolution with zero padding that keeps the size at stride 1. No bias: a norm must follow.
    pub fn normed(
        conv: &nn::Path<'_>,
        norm: &nn::Path<'_>,
        io: [i64; 2],
        kernel: i64,
        stride: i64,
    ) -> Self {
        let conv = Self::unbiased(conv, io, kernel, stride);
        conv.with_norm(Norm::new(norm, io[1])).with_relu()
    }

    /// `kernel x kernel` convolution with bias and nothing after it.
    pub fn biased(conv: &nn::Path<'_>, io: [i64; 2], kernel: i64, stride: i64) -> Self {
        Self::down(conv, io, kernel, stride, true)
    }

    /// `kernel x kernel` convolution without bias and with nothing after it.
    pub(crate) fn unbiased(conv: &nn::Path<'_>, io: [i64; 2], kernel: i64, stride: i64) -> Self {
        Self::down(conv, io, kernel, stride, false)
    }

    /// Convolution whose kernel is its stride, so that every input counts once; batch norm, ReLU.
    pub fn patches(conv: &nn::Path<'_>, norm: &nn::Path<'_>, io: [i64; 2], patch: i64) -> Self {
        Self {
            padding: 0,
            ..Self::normed(conv, norm, io, patch, patch)
        }
    }

    /// Transposed convolution whose kernel is its stride, so that outputs do not overlap; batch norm, ReLU.
    pub fn upsampling(conv: &nn::Path<'_>, norm: &nn::Path<'_>, io: [i64; 2], stride: i64) -> Self {
        let shape = [io[0], io[1], stride, stride];
        Self {
            weight: conv.var("weight", &shape, nn::init::DEFAULT_KAIMING_UNIFORM),
            bias: None,
            stride,
            padding: 0,
            direction: ConvDirection::Up,
            norm: Some(Norm::new(norm, io[1])),
            relu: true,
        }
    }

    fn down(path: &nn::Path<'_>, io: [i64; 2], kernel: i64, stride: i64, bias: bool) -> Self {
        let shape = [io[1], io[0], kernel, kernel];
        Self {
            weight: path.var("weight", &shape, nn::init::DEFAULT_KAIMING_UNIFORM),
            bias: bias.then(|| path.var("bias", &[io[1]], Init::Const(0.0))),
            stride,
            padding: kernel / 2,
            direction: ConvDirection::Down,
            norm: None,
            relu: false,
        }
    }

    /// The same with a batch norm after the convolution.
    pub(crate) fn with_norm(self, norm: Norm) -> Self {
        let norm = Some(norm);
        Self { norm, ..self }
    }

    /// The same with a ReLU at the end.
    pub(crate) fn with_relu(self) -> Self {
        Self { relu: true, ..self }
    }

    /// `[N, C_in, H, W]` to `[N, C_out, H', W']`.
    ///
    /// The convolution is computed in the precision of `x`; the parameters stay `f32`, and so do the statistics of the
    /// norm.
    pub fn forward(&self, x: &Tensor, train: bool) -> Tensor {
        let (stride, padding) = ([self.stride; 2], [self.padding; 2]);
        // In f32 both are the parameters themselves: a conversion to the same kind copies nothing.
        let weight = self.weight.to_kind(x.kind());
        let bias = self.bias.as_ref().map(|bias| bias.to_kind(x.kind()));
        let x = match self.direction {
            ConvDirection::Down => x.conv2d(&weight, bias, stride, padding, [1, 1], 1),
            ConvDirection::Up => {
                x.conv_transpose2d(&weight, bias, stride, padding, [0, 0], 1, [1, 1])
            }
        };
        let mut x = match &self.norm {
            Some(norm) => norm.forward(&x, train),
            None => x,
        };
        if self.relu { x.relu_() } else { x }
    }

    /// Output of a chain of layers.
    pub(crate) fn through(chain: &[Self], x: &Tensor, train: bool) -> Tensor {
        let x = x.shallow_clone();
        chain.iter().fold(x, |x, layer| layer.forward(&x, train))
    }

    /// [`Self::forward`] of one map in inference, the result contiguous as `[1, C_out, H', W']`.
    ///
    /// A 1x1 layer is one matrix product, whose result can be written in either order at no cost, while transposing a
    /// computed map takes longer than computing it.
    pub(crate) fn forward_contiguous(&self, x: &Tensor) -> Result<Tensor, TchError> {
        let (batch, input, height, width) = x.size4()?;
        let kernel = self.weight.size();
        let pointwise = batch == 1
            && kernel[2..] == [1, 1]
            && self.stride == 1
            && self.direction == ConvDirection::Down;
        let (true, Some(bias), None) = (pointwise, &self.bias, &self.norm) else {
            return self.forward(x, false).f_contiguous();
        };
        // A view if the channels are innermost in memory, as in the maps of inference.
        let cells = x.f_permute([0, 2, 3, 1])?;
        let cells = cells.f_reshape([height * width, input])?;
        let weight = self.weight.f_reshape([kernel[0], input])?;
        // `[C_out, C_in]` times `[C_in, H * W]`: the channels of the result are outermost.
        let mut rows = bias.f_unsqueeze(1)?.f_addmm(&weight, &cells.f_tr()?)?;
        let rows = if self.relu { rows.f_relu_()? } else { rows };
        rows.f_view([1, kernel[0], height, width])
    }

    /// The folded layer in integers, see [`Int8Convolution`].
    pub(crate) fn int8(
        &self,
        input: Quantisation,
        output: Option<Scale>,
    ) -> Result<Int8Convolution, TchError> {
        let format = LayerFormat {
            input,
            output,
            relu: self.relu,
        };
        let mut geometry = ConvGeometry {
            stride: self.stride,
            padding: self.padding,
            upsampling: 1,
        };
        let mut bias = self.bias.as_ref().map(Tensor::shallow_clone);
        let weight = match self.direction {
            ConvDirection::Down => self.weight.f_contiguous()?,
            ConvDirection::Up => {
                let (input, output, edge, _) = self.weight.size4()?;
                (geometry.stride, geometry.upsampling) = (1, edge);
                // Output channels become `[edge, edge, C_out]`: biases repeat for each cell of the square.
                bias = bias.map(|bias| bias.f_repeat([edge * edge])).transpose()?;
                let rows = self.weight.f_permute([2, 3, 1, 0])?;
                rows.f_reshape([edge * edge * output, input, 1, 1])?
            }
        };
        Int8Convolution::new(&weight, bias.as_ref(), geometry, format)
    }

    /// The same layer for inference: the norm's running statistics are folded into weight and bias, which saves one
    /// pass over the map; weights are channels-last, as the maps are.
    pub fn folded(&self) -> Self {
        let output_dim = match self.direction {
            ConvDirection::Down => 0,
            ConvDirection::Up => 1,
        };
        let bias = self.bias.as_ref().map(Tensor::detach);
        let (weight, bias) = match &self.norm {
            None => (self.weight.detach(), bias),
            Some(norm) => {
                let (scale, shift) = norm.scale_shift();
                let mut shape = [1_i64; 4];
                shape[output_dim] = -1;
                // The norm comes after the bias and scales it, too.
                let shift = match bias {
                    Some(bias) => bias * &scale + &shift,
                    None => shift,
                };
                (&self.weight * scale.view(shape), Some(shift))
            }
        };
        Self {
            weight: channels_last(&weight.detach()),
            bias: bias.map(|bias| bias.detach()),
            norm: None,
            ..*self
        }
    }
}

/// A map `[1, C, H, W]` whose channels are innermost in memory, contiguous: one transposition, which the library does
/// several times faster between two dimensions than between four.
pub(crate) fn contiguous_map(map: &Tensor) -> Result<Tensor, TchError> {
    let (batch, channels, height, width) = map.size4()?;
    if batch != 1 {
        return map.f_contiguous();
    }
    let cells = map.f_permute([0, 2, 3, 1])?;
    let cells = cells.f_reshape([height * width, channels])?;
    let rows = cells.f_tr()?.f_contiguous()?;
    rows.f_view([1, channels, height, width])
}

/// The same values with the channels innermost in memory.
pub fn channels_last(x: &Tensor) -> Tensor {
    x.permute([0, 2, 3, 1]).contiguous().permute([0, 3, 1, 2])
}

#[cfg(test)]
mod tests {
    use tch::nn::VarStore;
    use tch::{Device, Kind};

    use super::*;

    #[test]
    fn folded_and_contiguous_layers_compute_the_same() {
        tch::set_num_threads(1);
        tch::manual_seed(2);
        let network = VarStore::new(Device::Cpu);
        let root = network.root();
        let layers = [
            ConvLayer::normed(&(&root / "a"), &(&root / "an"), [12, 20], 1, 1),
            ConvLayer::normed(&(&root / "b"), &(&root / "bn"), [12, 20], 3, 2),
            ConvLayer::upsampling(&(&root / "c"), &(&root / "cn"), [12, 20], 4),
            ConvLayer::biased(&(&root / "d"), [12, 20], 1, 1)
                .with_norm(Norm::new(&(&root / "dn"), 20)),
        ];
        for (name, mut variable) in network.variables() {
            let low = if name.contains("var") { 0.3 } else { -0.5 };
            let _ = tch::no_grad(|| variable.uniform_(low, 0.9));
        }
        let x = channels_last(&Tensor::randn([1, 12, 8, 6], (Kind::Float, Device::Cpu)));
        for (index, layer) in layers.iter().enumerate() {
            let expected = tch::no_grad(|| layer.forward(&x, false));
            let folded = tch::no_grad(|| layer.folded());
            let contiguous = folded.forward_contiguous(&x).unwrap();
            assert!(
                folded
                    .forward(&x, false)
                    .allclose(&expected, 1e-5, 1e-5, false),
                "{index}"
            );
            assert!(
                contiguous.is_contiguous() && contiguous.allclose(&expected, 1e-5, 1e-5, false),
                "{index}"
            );
        }
    }
}
