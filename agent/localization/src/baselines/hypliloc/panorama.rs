//! Panorama: the tokens of a sweep as a circular image of one row, its rings as channels.

use tch::{Tensor, nn};

use super::token_layer::TokenLayer;
use crate::baselines::tokens::{RINGS, SECTORS};

/// `[S, SECTORS, RINGS * C]` of tokens `[S, TOKENS, C]`.
pub(super) fn panorama(tokens: &Tensor) -> tch::Result<Tensor> {
    let (sweeps, _, channels) = tokens.size3()?;
    tokens
        .f_view([sweeps, RINGS, SECTORS, channels])?
        .f_transpose(1, 2)?
        .f_reshape([sweeps, SECTORS, RINGS * channels])
}

/// Circular convolution over three columns, layer norm and ReLU.
#[derive(Debug)]
pub(super) struct CircularLayer(TokenLayer);

impl CircularLayer {
    /// Builds the layer below `path`.
    pub(super) fn new(path: &nn::Path<'_>, inputs: i64) -> Self {
        Self(TokenLayer::new(path, 3 * inputs))
    }

    /// `[S, SECTORS, C]` to `[S, SECTORS, C']`, in the precision of the columns.
    pub(super) fn forward(&self, columns: &Tensor) -> tch::Result<Tensor> {
        // The first column and the last are neighbours: a roll has no edge to pad.
        let (before, after) = (columns.f_roll(1, 1)?, columns.f_roll(-1, 1)?);
        self.0
            .forward(&Tensor::f_cat(&[&before, columns, &after], 2)?)
    }
}
