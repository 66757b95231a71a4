//! What a detector returns.

use protocol::StageTiming;
use tch::{TchError, Tensor};

use super::error::DetectorError;
use crate::layers::head::HeadOutput;

/// What the encoder makes of one sweep.
#[derive(Debug)]
pub struct Encoded {
    /// `[1, C, H, W]` `f32`, contiguous, before the compressor where there is one:
    /// [`Detector::squeezed`](super::Detector::squeezed) makes of it the transmitted map.
    pub features: Tensor,
    /// Points inside the area.
    pub points: usize,
    /// Pillars on them.
    pub pillars: usize,
    /// Time of crop and sorting into pillars, pillar features, and 2D convolutions.
    pub times: Vec<StageTiming>,
}

/// What the head makes of a map.
#[derive(Debug, Clone, PartialEq)]
pub struct Heads {
    /// `[A, H, W]` logits.
    pub scores: Vec<f32>,
    /// `[7 A, H, W]` offsets.
    pub offsets: Vec<f32>,
    /// `[H, W]`, 0..1: how sure the head is of a vehicle around each cell.
    pub confidence: Vec<f32>,
}

impl Heads {
    /// Takes the output for one map to plain values.
    ///
    /// # Errors
    /// The tensor library's.
    pub fn new(output: &HeadOutput) -> Result<Self, DetectorError> {
        Ok(Self {
            scores: flat(&output.scores)?,
            offsets: flat(&output.offsets)?,
            confidence: flat(&output.confidence())?,
        })
    }
}

/// The values of a tensor in row-major order.
pub(super) fn flat(tensor: &Tensor) -> Result<Vec<f32>, TchError> {
    Vec::try_from(&tensor.f_contiguous()?.f_view([-1])?)
}
