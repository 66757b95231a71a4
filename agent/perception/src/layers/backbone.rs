//! 2D backbone: blocks that halve the feature map, each up-sampled to one BEV grid and concatenated.

use tch::{Tensor, nn};

use crate::layers::convolution::ConvLayer;
use crate::layers::residual::ResidualBlock;
use crate::model_config::{BlockKind, DetectorConfig};

/// Blocks of 3x3 convolutions and their up-sampling branches.
#[derive(Debug)]
pub struct BevBackbone {
    blocks: Vec<BackboneBlock>,
    deblocks: Vec<ConvLayer>,
}

/// Layers of one level.
#[derive(Debug)]
enum BackboneBlock {
    Plain(Vec<ConvLayer>),
    Residual(Vec<ResidualBlock>),
}

impl BevBackbone {
    /// Parameters `blocks.<level>.<position>.*` (with residual blocks `resnet.layer<level>.<position>.*`) and
    /// `deblocks.<level>.<0|1>.*` under `path`.
    pub fn new(path: &nn::Path<'_>, config: &DetectorConfig) -> Self {
        let mut input = config.pillar_channels;
        let (mut blocks, mut deblocks) = (Vec::new(), Vec::new());
        for (level, &filters) in config.num_filters.iter().enumerate() {
            let (layers, stride) = (config.layer_nums[level], config.layer_strides[level]);
            let io = [input, filters];
            blocks.push(match config.blocks {
                BlockKind::Plain => {
                    BackboneBlock::Plain(block(&(path / "blocks" / level), io, layers, stride))
                }
                BlockKind::Residual => {
                    let path = path / "resnet" / format!("layer{level}");
                    BackboneBlock::Residual(ResidualBlock::chain(&path, io, layers, stride))
                }
            });
            let deblock = path / "deblocks" / level;
            let io = [filters, config.num_upsample_filters[level]];
            let (conv, norm, up) = (&deblock / 0, &deblock / 1, config.upsample_strides[level]);
            deblocks.push(ConvLayer::upsampling(&conv, &norm, io, up));
            input = filters;
        }
        Self { blocks, deblocks }
    }

    /// `[N, C, H, W]` to the concatenated levels `[N, sum of C_up, H', W']`.
    pub fn forward(&self, x: &Tensor, train: bool) -> Tensor {
        self.upsampled(&self.levels_of(x, train), train)
    }

    /// Number of levels.
    pub fn levels(&self) -> usize {
        self.blocks.len()
    }

    /// Outputs of all levels for a canvas `[N, C, H, W]`, each the input of the next.
    pub fn levels_of(&self, canvas: &Tensor, train: bool) -> Vec<Tensor> {
        let mut x = canvas.shallow_clone();
        let levels = (0..self.levels()).map(|level| {
            x = self.level(level, &x, train);
            x.shallow_clone()
        });
        levels.collect()
    }

    /// Output of one level for the output of the level above it, or for the canvas.
    ///
    /// # Panics
    /// When there is no such level.
    pub fn level(&self, level: usize, x: &Tensor, train: bool) -> Tensor {
        match &self.blocks[level] {
            BackboneBlock::Plain(layers) => ConvLayer::through(layers, x, train),
            BackboneBlock::Residual(blocks) => {
                let x = x.shallow_clone();
                blocks.iter().fold(x, |x, block| block.forward(&x, train))
            }
        }
    }

    /// Up-samples the outputs of all levels, own or fused, to one BEV grid: `[N, sum of C_up, H', W']`.
    pub fn upsampled(&self, levels: &[Tensor], train: bool) -> Tensor {
        let levels = self.deblocks.iter().zip(levels);
        let levels = levels.map(|(deblock, level)| deblock.forward(level, train));
        let mut levels: Vec<Tensor> = levels.collect();
        match levels.len() {
            1 => levels.remove(0),
            _ => Tensor::cat(&levels, 1),
        }
    }

    /// Layers of every level and up-sampling layers; `None` with residual blocks.
    pub(crate) fn plain_layers(&self) -> Option<(Vec<&[ConvLayer]>, &[ConvLayer])> {
        let levels = self.blocks.iter().map(|block| match block {
            BackboneBlock::Plain(layers) => Some(layers.as_slice()),
            BackboneBlock::Residual(_) => None,
        });
        Some((levels.collect::<Option<Vec<_>>>()?, &self.deblocks))
    }

    /// The same backbone for inference, norms folded into the convolutions.
    pub fn folded(&self) -> Self {
        let blocks = self.blocks.iter().map(|block| match block {
            BackboneBlock::Plain(layers) => {
                BackboneBlock::Plain(layers.iter().map(ConvLayer::folded).collect())
            }
            BackboneBlock::Residual(blocks) => {
                BackboneBlock::Residual(blocks.iter().map(ResidualBlock::folded).collect())
            }
        });
        let blocks = blocks.collect();
        let deblocks = self.deblocks.iter().map(ConvLayer::folded).collect();
        Self { blocks, deblocks }
    }
}

/// One strided convolution and `layers` more.
///
/// The reference numbers zero padding, convolution, norm and ReLU in one list, so the first convolution is 1, its norm
/// 2, and each later pair is three further.
fn block(
    path: &nn::Path<'_>,
    [input, filters]: [i64; 2],
    layers: usize,
    stride: i64,
) -> Vec<ConvLayer> {
    let layers = (0..=layers).map(|layer| {
        let (io, stride) = match layer {
            0 => ([input, filters], stride),
            _ => ([filters, filters], 1),
        };
        let (conv, norm) = (path / (3 * layer + 1), path / (3 * layer + 2));
        ConvLayer::normed(&conv, &norm, io, 3, stride)
    });
    layers.collect()
}
