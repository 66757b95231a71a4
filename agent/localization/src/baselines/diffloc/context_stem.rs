//! Stem: residual context blocks at the resolution of the range image, then one token per patch.

use perception::layers::convolution::{Norm, channels_last};
use tch::nn::{self, Init};
use tch::{Kind, TchError, Tensor};

use super::config::DiffLocConfig;
use super::range_image::CHANNELS;
use crate::pgc::dense::Dense;

/// A convolution that keeps the size, with a leaky rectifier.
#[derive(Debug)]
struct Convolution {
    weight: Tensor,
    bias: Tensor,
    padding: i64,
    dilation: i64,
}

impl Convolution {
    fn new(path: &nn::Path<'_>, [inputs, outputs]: [i64; 2], kernel: i64, dilation: i64) -> Self {
        let shape = [outputs, inputs, kernel, kernel];
        Self {
            weight: path.var("weight", &shape, nn::init::DEFAULT_KAIMING_UNIFORM),
            bias: path.var("bias", &[outputs], Init::Const(0.0)),
            padding: dilation * (kernel / 2),
            dilation,
        }
    }

    fn forward(&self, x: &Tensor) -> Result<Tensor, TchError> {
        let weight = self.weight.f_to_kind(x.kind())?;
        let bias = Some(self.bias.f_to_kind(x.kind())?);
        let (padding, dilation) = ([self.padding; 2], [self.dilation; 2]);
        let y = x.f_conv2d(&weight, bias, [1, 1], padding, dilation, 1)?;
        y.f_leaky_relu()
    }
}

/// Context block: a 1 x 1 convolution, and two wider ones, the second dilated, beside it.
#[derive(Debug)]
struct ContextBlock {
    shortcut: Convolution,
    near: (Convolution, Norm),
    far: (Convolution, Norm),
}

impl ContextBlock {
    fn new(path: &nn::Path<'_>, inputs: i64, outputs: i64) -> Self {
        let normed = |name: &str, dilation| {
            let below = path / name;
            let norm = Norm::with_defaults(&(&below / "norm"), outputs);
            let convolution = Convolution::new(&below, [outputs, outputs], 3, dilation);
            (convolution, norm)
        };
        Self {
            shortcut: Convolution::new(&(path / "shortcut"), [inputs, outputs], 1, 1),
            near: normed("near", 1),
            far: normed("far", 2),
        }
    }

    fn forward(&self, x: &Tensor, train: bool) -> Result<Tensor, TchError> {
        let shortcut = self.shortcut.forward(x)?;
        let near = self.near.1.forward(&self.near.0.forward(&shortcut)?, train);
        let far = self.far.1.forward(&self.far.0.forward(&near)?, train);
        shortcut.f_add(&far)
    }
}

/// From range images to tokens.
#[derive(Debug)]
pub(super) struct ContextStem {
    blocks: Vec<ContextBlock>,
    patch: [i64; 2],
    project: Dense,
}

impl ContextStem {
    /// Builds the layers below `path`.
    pub(super) fn new(path: &nn::Path<'_>, config: &DiffLocConfig) -> Self {
        let [first, last] = config.stem;
        let widths = [CHANNELS as i64, first, first, first, last];
        let block =
            |number: usize| ContextBlock::new(&(path / number), widths[number], widths[number + 1]);
        Self {
            blocks: (0..4).map(block).collect(),
            patch: config.patch,
            project: Dense::new(&(path / "project"), last, config.width, 0.7),
        }
    }

    /// `[B, CHANNELS, rows, columns]` to tokens `[B, T, width]`, row by row.
    pub(super) fn forward(&self, images: &Tensor, train: bool) -> Result<Tensor, TchError> {
        // In half precision convolutions are faster where channels lie next to each other in memory.
        let images = match images.kind() {
            Kind::Float => images.shallow_clone(),
            _ => channels_last(images),
        };
        let mut blocks = self.blocks.iter();
        let x = blocks.try_fold(images, |x, block| block.forward(&x, train))?;
        let pooled = x.f_avg_pool2d(self.patch, self.patch, [0, 0], false, true, None)?;
        let tokens = pooled.f_flatten(2, 3)?.f_transpose(1, 2)?;
        self.project.forward(&tokens)
    }
}
