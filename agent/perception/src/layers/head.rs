//! Detection head: class logits and box offsets of every anchor.

use tch::nn::{self, Init};
use tch::{Kind, TchError, Tensor};

use crate::model_config::BOX_CODE;

/// Share of positive anchors that a new head assumes, so that the first steps are not spent on unlearning vehicles in
/// half of the cells (RetinaNet's prior).
const PRIOR: f64 = 0.01;

/// Output of the head for a feature map, before any decoding.
#[derive(Debug)]
pub struct HeadOutput {
    /// `[B, A, H, W]` logits, one per anchor (the reference's `psm`).
    pub scores: Tensor,
    /// `[B, 7 A, H, W]` offsets, channel `7 * anchor + component` (the reference's `rm`).
    pub offsets: Tensor,
}

/// Two 1x1 convolutions with bias.
#[derive(Debug)]
pub struct DetectionHead {
    scores: nn::Conv2D,
    offsets: nn::Conv2D,
}

impl DetectionHead {
    /// Parameters `cls_head.*` and `reg_head.*` under `path`.
    #[must_use]
    pub fn new(path: &nn::Path<'_>, channels: i64, anchors: i64) -> Self {
        let init = |mean| nn::ConvConfig {
            ws_init: Init::Randn { mean: 0.0, stdev: 0.01 },
            bs_init: Init::Const(mean),
            ..Default::default()
        };
        let prior = -((1.0 - PRIOR) / PRIOR).ln();
        Self {
            scores: nn::conv2d(path / "cls_head", channels, anchors, 1, init(prior)),
            offsets: nn::conv2d(path / "reg_head", channels, anchors * BOX_CODE, 1, init(0.0)),
        }
    }

    /// `[B, C, H, W]` features to scores and offsets.
    ///
    /// # Errors
    /// Those of the tensor library, when the features have another number of channels than the head.
    pub fn forward(&self, features: &Tensor) -> Result<HeadOutput, TchError> {
        let apply = |conv: &nn::Conv2D| features.f_conv2d(&conv.ws, conv.bs.as_ref(), [1, 1], [0, 0], [1, 1], 1);
        Ok(HeadOutput { scores: apply(&self.scores)?, offsets: apply(&self.offsets)? })
    }
}

impl HeadOutput {
    /// Confidence of a vehicle around each cell: `[B, H, W]`, 0..1, the best of its anchors.
    pub fn confidence(&self) -> Tensor {
        self.scores.amax([1], false).sigmoid().to_kind(Kind::Float)
    }
}
