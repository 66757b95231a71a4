//! Convolution that can be applied to parts of its input channels, and a GRU built on it.

use tch::nn;
use tch::{TchError, Tensor};

use super::layers::uniform;

/// A convolution with bias that keeps the size of the feature map.
#[derive(Debug)]
pub(super) struct Conv {
    /// `[out, in, k, k]`, or `[out, in]` for a layer that a reference applies to the last dimension.
    weight: Tensor,
    /// `[out]`.
    bias: Tensor,
}

impl Conv {
    /// `weight` `[out, in, kernel, kernel]` and `bias` `[out]` below `path`.
    pub(super) fn new(path: &nn::Path<'_>, [input, output]: [i64; 2], kernel: i64) -> Self {
        Self::of_shape(path, &[output, input, kernel, kernel])
    }

    /// The same per cell, its weight stored as `[out, in]`.
    pub(super) fn linear(path: &nn::Path<'_>, [input, output]: [i64; 2]) -> Self {
        Self::of_shape(path, &[output, input])
    }

    fn of_shape(path: &nn::Path<'_>, shape: &[i64]) -> Self {
        let bound = 1.0 / (shape[1..].iter().product::<i64>() as f64).sqrt();
        Self {
            weight: path.var("weight", shape, nn::init::DEFAULT_KAIMING_UNIFORM),
            bias: path.var("bias", &shape[..1], uniform(bound)),
        }
    }

    /// `[out, in, k, k]`.
    fn kernel(&self) -> Result<Tensor, TchError> {
        if self.weight.dim() == 4 {
            return Ok(self.weight.shallow_clone());
        }
        self.weight.f_unsqueeze(-1)?.f_unsqueeze(-1)
    }

    /// `[N, in, H, W]` to `[N, out, H, W]`.
    pub(super) fn apply(&self, x: &Tensor) -> Result<Tensor, TchError> {
        convolve(x, &self.kernel()?, Some(&self.bias))
    }

    /// Contribution of the input channels from `first` on, where `x` holds only those.
    pub(super) fn part(&self, x: &Tensor, first: i64, with_bias: bool) -> Result<Tensor, TchError> {
        let kernel = self.kernel()?.f_narrow(1, first, x.size4()?.1)?;
        convolve(x, &kernel, with_bias.then_some(&self.bias))
    }
}

fn convolve(x: &Tensor, kernel: &Tensor, bias: Option<&Tensor>) -> Result<Tensor, TchError> {
    let padding = kernel.size()[2] / 2;
    let kernel = kernel.f_to_kind(x.kind())?;
    let bias = bias.map(|bias| bias.f_to_kind(x.kind())).transpose()?;
    x.f_conv2d(&kernel, bias, [1, 1], [padding; 2], [1, 1], 1)
}

/// A convolutional GRU of which only the first step is computed.
#[derive(Debug)]
pub(super) struct ConvGru {
    /// Of each layer the gates, reset then update, and the new state, all of input and state.
    cells: Vec<[Conv; 2]>,
    hidden: i64,
}

impl ConvGru {
    /// Parameters `cell_list.<layer>.{conv_gates,conv_can}.*` below `path`.
    pub(super) fn new(
        path: &nn::Path<'_>,
        [input, hidden]: [i64; 2],
        kernel: i64,
        layers: usize,
    ) -> Self {
        Self {
            cells: (0..layers)
                .map(|layer| {
                    let path = path / "cell_list" / layer;
                    let input = if layer == 0 { input } else { hidden } + hidden;
                    [("conv_gates", 2 * hidden), ("conv_can", hidden)]
                        .map(|(name, output)| Conv::new(&(&path / name), [input, output], kernel))
                })
                .collect(),
            hidden,
        }
    }

    /// The state `[N, hidden, H, W]` after an input `x` `[N, in, H, W]` to an empty state: `update * candidate`.
    pub(super) fn first_state(&self, x: &Tensor) -> Result<Tensor, TchError> {
        let hidden = self.hidden;
        self.cells
            .iter()
            .try_fold(x.shallow_clone(), |x, [gates, candidate]| {
                let input = x.size4()?.1;
                // Update gate and candidate in one convolution over the input alone.
                let [kernel, bias] = [
                    (&gates.weight, &candidate.weight),
                    (&gates.bias, &candidate.bias),
                ]
                .map(|(gates, candidate)| {
                    Tensor::f_cat(&[&gates.f_narrow(0, hidden, hidden)?, candidate], 0)
                });
                // Only the weights of the input: those of the state would multiply zeros.
                let kernel = kernel?.f_narrow(1, 0, input)?;
                let both = convolve(&x, &kernel, Some(&bias?))?;
                Ok(both.f_narrow(1, 0, hidden)?.f_sigmoid()?
                    * both.f_narrow(1, hidden, hidden)?.f_tanh()?)
            })
    }
}
