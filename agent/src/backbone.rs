//! The 2D backbone: blocks that halve the map, each brought back to one lattice and concatenated.

use tch::{TchError, Tensor, nn};

use crate::agent_attention::attend_samples;
use crate::convolution::ConvLayer;
use crate::model_config::DetectorConfig;

/// Blocks of 3x3 convolutions and their up-sampling branches.
#[derive(Debug)]
pub struct BevBackbone {
    blocks: Vec<Vec<ConvLayer>>,
    deblocks: Vec<ConvLayer>,
}

impl BevBackbone {
    /// Parameters `blocks.<level>.<position>.*` and `deblocks.<level>.<0|1>.*` under `path`.
    #[must_use]
    pub fn new(path: &nn::Path<'_>, config: &DetectorConfig) -> Self {
        let mut input = config.pillar_channels;
        let mut backbone = Self { blocks: Vec::new(), deblocks: Vec::new() };
        for (level, &filters) in config.num_filters.iter().enumerate() {
            let stride = config.layer_strides[level];
            backbone.blocks.push(block(&(path / "blocks" / level), [input, filters], config.layer_nums[level], stride));
            let deblock = path / "deblocks" / level;
            let io = [filters, config.num_upsample_filters[level]];
            let layer = ConvLayer::upsampling(&(&deblock / 0), &(&deblock / 1), io, config.upsample_strides[level]);
            backbone.deblocks.push(layer);
            input = filters;
        }
        backbone
    }

    /// `[N, C, H, W]` to the concatenated levels `[N, sum of C_up, H', W']`.
    pub fn forward(&self, x: &Tensor, train: bool) -> Tensor {
        let unfused = |level: &Tensor| Ok(level.shallow_clone());
        self.run(x, train, unfused).expect("a backbone without fusion has no shape from outside")
    }

    /// AttFuse's backbone: after every level the agents of a sample are fused on their way to the up-sampling branch,
    /// while every agent's own features go on down.
    ///
    /// # Shapes
    /// - `x`: `[sum of record_len, C, H, W]`, all agents on their ego's lattice, ego first in each sample
    /// - returns: `[B, sum of C_up, H', W']`
    ///
    /// # Errors
    /// The tensor library's, when `record_len` does not add up to the number of maps.
    pub fn forward_fused(&self, x: &Tensor, record_len: &[i64], train: bool) -> Result<Tensor, TchError> {
        self.run(x, train, |level| attend_samples(level, record_len))
    }

    /// The same backbone for inference, norms folded into the convolutions.
    #[must_use]
    pub fn folded(&self) -> Self {
        let fold = |layers: &Vec<ConvLayer>| layers.iter().map(ConvLayer::folded).collect();
        Self { blocks: self.blocks.iter().map(fold).collect(), deblocks: fold(&self.deblocks) }
    }

    fn run(
        &self,
        x: &Tensor,
        train: bool,
        fuse: impl Fn(&Tensor) -> Result<Tensor, TchError>,
    ) -> Result<Tensor, TchError> {
        let mut x = x.shallow_clone();
        let mut levels = Vec::with_capacity(self.blocks.len());
        for (block, deblock) in self.blocks.iter().zip(&self.deblocks) {
            for layer in block {
                x = layer.forward(&x, train);
            }
            levels.push(deblock.forward(&fuse(&x)?, train));
        }
        Ok(if levels.len() == 1 { levels.remove(0) } else { Tensor::cat(&levels, 1) })
    }
}

/// One strided convolution and `layers` more.
///
/// The reference numbers zero padding, convolution, norm and ReLU in one list, so the first convolution is 1, its norm
/// 2, and each later pair is three further.
fn block(path: &nn::Path<'_>, [input, filters]: [i64; 2], layers: usize, stride: i64) -> Vec<ConvLayer> {
    (0..=layers)
        .map(|layer| {
            let (position, io, stride) = match layer {
                0 => (1, [input, filters], stride),
                _ => (3 * layer + 1, [filters, filters], 1),
            };
            ConvLayer::normed(&(path / position), &(path / (position + 1)), io, 3, stride)
        })
        .collect()
}
