//! Reduction of the backbone output to the transmitted feature map, and a learnt compressor of its channels.

use tch::{TchError, Tensor, nn};

use crate::layers::convolution::{ConvLayer, Norm};
use crate::model_config::ShrinkConfig;

/// Reduces the concatenated backbone levels.
#[derive(Debug, Default)]
pub struct Shrink {
    pub(crate) layers: Vec<ConvLayer>,
}

impl Shrink {
    /// Parameters `layers.0.double_conv.{0,2}.*` (OpenCOOD) or `layers.0.{0,1}.*` (pointwise) under `path`.
    pub fn new(path: &nn::Path<'_>, input: i64, config: &ShrinkConfig) -> Self {
        let layer = path / "layers" / 0;
        let layers = match *config {
            ShrinkConfig::DoubleConv { channels, stride } => {
                let double = layer / "double_conv";
                let first = ConvLayer::biased(&(&double / 0), [input, channels], 3, stride);
                let second = ConvLayer::biased(&(&double / 2), [channels; 2], 3, 1);
                vec![first.with_relu(), second.with_relu()]
            }
            ShrinkConfig::Pointwise { channels } => {
                let (conv, norm) = (&layer / 0, &layer / 1);
                vec![ConvLayer::normed(&conv, &norm, [input, channels], 1, 1)]
            }
        };
        Self { layers }
    }

    /// `[N, C_in, H, W]` to `[N, C, H', W']`.
    pub fn forward(&self, x: &Tensor, train: bool) -> Tensor {
        ConvLayer::through(&self.layers, x, train)
    }

    /// [`Self::forward`] of one map in inference, contiguous.
    pub(crate) fn forward_contiguous(&self, x: &Tensor) -> Result<Tensor, TchError> {
        match self.layers.split_last() {
            Some((last, rest)) => last.forward_contiguous(&ConvLayer::through(rest, x, false)),
            None => x.f_contiguous(),
        }
    }

    /// The same for inference, norms folded in.
    pub fn folded(&self) -> Self {
        let layers = self.layers.iter().map(ConvLayer::folded).collect();
        Self { layers }
    }
}

/// Compresses the channels before transmission and expands them after it (OpenCOOD's `NaiveCompressor`): the sender has
/// the first half, every receiver the second.
#[derive(Debug)]
pub struct Compressor {
    encoder: ConvLayer,
    decoder: Vec<ConvLayer>,
}

impl Compressor {
    /// `channels` to `channels / ratio` and back; parameters `encoder.*` and `decoder.*` under `path`.
    pub fn new(path: &nn::Path<'_>, channels: i64, ratio: i64) -> Self {
        let code = (channels / ratio).max(1);
        let decoder = path / "decoder";
        Self {
            encoder: layer(&(path / "encoder"), 0, [channels, code]),
            decoder: vec![
                layer(&decoder, 0, [code, channels]),
                layer(&decoder, 3, [channels, channels]),
            ],
        }
    }

    /// `[N, C, H, W]` to the code `[N, C / ratio, H, W]`.
    pub fn encode(&self, x: &Tensor, train: bool) -> Tensor {
        self.encoder.forward(x, train)
    }

    /// The code back to `[N, C, H, W]`.
    pub fn decode(&self, code: &Tensor, train: bool) -> Tensor {
        ConvLayer::through(&self.decoder, code, train)
    }

    /// The same for inference, norms folded in.
    pub fn folded(&self) -> Self {
        let encoder = self.encoder.folded();
        let decoder = self.decoder.iter().map(ConvLayer::folded).collect();
        Self { encoder, decoder }
    }
}

fn layer(part: &nn::Path<'_>, position: i64, io: [i64; 2]) -> ConvLayer {
    let conv = ConvLayer::biased(&(part / position), io, 3, 1);
    let norm = Norm::new(&(part / (position + 1)), io[1]);
    conv.with_norm(norm).with_relu()
}
