//! Vision transformer (Eq. 8, 9): attention over agents and time at each cell and within windows, then an MLP, in
//! pre-norm blocks.
//!
//! Full attention over all cells of all maps is too expensive. As in V2X-ViT, tokens attend over agents and time at
//! each cell, and across cells within windows of several sizes.

mod attention;
mod block;
mod window_loops;

use tch::{Device, TchError, Tensor, nn};

use self::block::PastatBlock;
use super::config::PastatConfig;
use super::extensions::ego_queries::Others;
use super::patches::{Tokens, channels_last};

/// The blocks of the transformer.
#[derive(Debug)]
pub(super) struct Transformer {
    blocks: Vec<PastatBlock>,
}

impl Transformer {
    /// Its variables are `blocks.*` below `path`.
    pub(super) fn new(path: &nn::Path<'_>, config: &PastatConfig) -> Self {
        Self {
            blocks: (0..config.depth)
                .map(|index| PastatBlock::new(&(path / "blocks" / index), config))
                .collect(),
        }
    }

    /// Context of the ego: its tokens `[1, h, w, D]` after all blocks.
    pub(super) fn forward(&self, Tokens { values, valid }: &Tokens) -> Result<Tensor, TchError> {
        // Only the ego's tokens change from block to block: the others are prepared once and never projected.
        if values.device() == Device::Cpu && !values.requires_grad() {
            let (others, valid) = (Others::of(values, valid)?, valid.f_narrow(0, 0, 1)?);
            let ego = channels_last(&values.f_narrow(0, 0, 1)?)?;
            return self
                .blocks
                .iter()
                .try_fold(ego, |ego, block| block.gather(&ego, &others, &valid));
        }
        let mut tokens = channels_last(values)?;
        let others = tokens.f_narrow(0, 1, tokens.size()[0] - 1)?;
        for block in &self.blocks {
            let ego = block.forward(&tokens, valid)?;
            tokens = Tensor::f_cat(&[&ego, &others], 0)?;
        }
        tokens.f_narrow(0, 0, 1)
    }
}
