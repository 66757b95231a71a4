//! Quantised backbone and shrink: canvas to feature map.

use tch::{TchError, Tensor};

use super::backbone_level::BackboneLevel;
use crate::int8::{ActivationScales, Int8Convolution, Quantisation, QuantiseError, ScaleSearch};
use crate::layers::backbone::BevBackbone;
use crate::layers::convolution::contiguous_map;
use crate::layers::shrink::Shrink;

/// Name of the canvas among the activations.
pub(super) const CANVAS: &str = "pillar_vfe.canvas";
/// Name of the up-sampled levels, which are concatenated and therefore share a scale.
const UPSAMPLED: &str = "backbone.upsampled";

/// Backbone of plain blocks with a shrink layer, in integers.
#[derive(Debug)]
pub(super) struct Int8Backbone {
    blocks: Vec<Vec<Int8Convolution>>,
    /// Meaning of the values behind each block.
    quantisations: Vec<Quantisation>,
    deblocks: Vec<Int8Convolution>,
    /// The last of them gives `f32`.
    shrink: Vec<Int8Convolution>,
}

impl Int8Backbone {
    /// Quantises a folded backbone and its shrink layers; `None` if it has residual blocks or no shrink layer, which
    /// stay in floating point.
    ///
    /// # Errors
    /// [`QuantiseError`] names the activation whose scale is missing.
    pub(super) fn new(
        backbone: &BevBackbone,
        shrink: &Shrink,
        scales: &ActivationScales,
    ) -> Result<Option<Self>, QuantiseError> {
        let shrink = shrink.layers.split_last();
        let (Some((levels, up)), Some((last, hidden))) = (backbone.plain_layers(), shrink) else {
            return Ok(None);
        };
        let mut input = scales.get(CANVAS)?;
        let (mut blocks, mut quantisations, mut deblocks) = (Vec::new(), Vec::new(), Vec::new());
        let upsampled = scales.get(UPSAMPLED)?;
        for (level, (layers, deblock)) in levels.into_iter().zip(up).enumerate() {
            let mut block = Vec::new();
            for (position, layer) in layers.iter().enumerate() {
                let output = scales.get(&block_activation(level, position))?;
                block.push(layer.int8(input, Some(output.scale))?);
                input = output;
            }
            blocks.push(block);
            quantisations.push(input);
            deblocks.push(deblock.int8(input, Some(upsampled.scale))?);
        }
        let mut input = upsampled;
        let mut shrunk = Vec::new();
        for (position, layer) in hidden.iter().enumerate() {
            let output = scales.get(&shrink_activation(position))?;
            shrunk.push(layer.int8(input, Some(output.scale))?);
            input = output;
        }
        shrunk.push(last.int8(input, None)?);
        Ok(Some(Self {
            blocks,
            quantisations,
            deblocks,
            shrink: shrunk,
        }))
    }

    /// Levels of the quantised canvas `[1, C_pillar, H, W]`.
    pub(super) fn levels(&self, canvas: &Tensor) -> Result<Vec<BackboneLevel>, TchError> {
        let mut x = canvas.shallow_clone();
        let mut levels = Vec::with_capacity(self.blocks.len());
        for (block, &quantisation) in self.blocks.iter().zip(&self.quantisations) {
            x = through(block, x)?;
            levels.push(BackboneLevel::new(x.shallow_clone(), Some(quantisation)));
        }
        Ok(levels)
    }

    /// Feature map `[1, C, H', W']`, `f32` and contiguous, of the levels' values.
    pub(super) fn features(&self, levels: &[Tensor]) -> Result<Tensor, TchError> {
        let upsampled = self.deblocks.iter().zip(levels);
        let upsampled = upsampled.map(|(deblock, level)| deblock.forward(level));
        let upsampled: Vec<Tensor> = upsampled.collect::<Result<_, _>>()?;
        contiguous_map(&through(&self.shrink, Tensor::f_cat(&upsampled, 1)?)?)
    }
}

fn through(layers: &[Int8Convolution], x: Tensor) -> Result<Tensor, TchError> {
    layers.iter().try_fold(x, |x, layer| layer.forward(&x))
}

fn block_activation(level: usize, position: usize) -> String {
    format!("backbone.blocks.{level}.{position}")
}

fn shrink_activation(position: usize) -> String {
    format!("shrink_conv.{position}")
}

/// Adds the activations that quantising a folded backbone and its shrink layers needs, for a canvas
/// `[1, C_pillar, H, W]`; nothing if they stay in floating point.
pub(super) fn observe_backbone(
    backbone: &BevBackbone,
    shrink: &Shrink,
    canvas: &Tensor,
    search: &mut ScaleSearch,
) -> Result<(), TchError> {
    // The output of the last layer is `f32` and has no scale.
    let shrink = shrink.layers.split_last();
    let (Some((levels, up)), Some((_, hidden))) = (backbone.plain_layers(), shrink) else {
        return Ok(());
    };
    search.observe(CANVAS, canvas)?;
    let mut x = canvas.shallow_clone();
    let mut upsampled = Vec::new();
    for (level, (layers, deblock)) in levels.into_iter().zip(up).enumerate() {
        for (position, layer) in layers.iter().enumerate() {
            x = layer.forward(&x, false);
            search.observe(&block_activation(level, position), &x)?;
        }
        upsampled.push(deblock.forward(&x, false));
    }
    let wide = Tensor::f_cat(&upsampled, 1)?;
    let mut x = wide.shallow_clone();
    for (position, layer) in hidden.iter().enumerate() {
        x = layer.forward(&x, false);
        search.observe(&shrink_activation(position), &x)?;
    }
    search.observe(UPSAMPLED, &wide)
}
