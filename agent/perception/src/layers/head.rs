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
    pub fn new(path: &nn::Path<'_>, channels: i64, anchors: i64) -> Self {
        let usual = nn::ConvConfig {
            ws_init: Init::Randn {
                mean: 0.0,
                stdev: 0.01,
            },
            bs_init: Init::Const(0.0),
            ..Default::default()
        };
        let prior = nn::ConvConfig {
            bs_init: Init::Const(-((1.0 - PRIOR) / PRIOR).ln()),
            ..usual
        };
        let numbers = anchors * BOX_CODE;
        let scores = nn::conv2d(path / "cls_head", channels, anchors, 1, prior);
        let offsets = nn::conv2d(path / "reg_head", channels, numbers, 1, usual);
        Self { scores, offsets }
    }

    /// `[B, C, H, W]` features to scores and offsets.
    ///
    /// # Errors
    /// Those of the tensor library, when the features have another number of channels than the head.
    pub fn forward(&self, features: &Tensor) -> Result<HeadOutput, TchError> {
        let scores = convolved(features, &self.scores)?;
        let offsets = convolved(features, &self.offsets)?;
        Ok(HeadOutput { scores, offsets })
    }

    /// The same of one map `[1, C, H, W]` for inference: one matrix product, in whatever order the map is in memory.
    ///
    /// # Errors
    /// As [`Self::forward`].
    pub fn forward_one(&self, map: &Tensor) -> Result<HeadOutput, TchError> {
        let (_, _, height, width) = map.size4()?;
        let both = [&self.scores, &self.offsets];
        let weight = Tensor::f_cat(&both.map(|conv| &conv.ws), 0)?.f_flatten(1, 3)?;
        let cells = map.f_squeeze_dim(0)?.f_flatten(1, 2)?;
        let biases: Vec<&Tensor> = both.iter().filter_map(|conv| conv.bs.as_ref()).collect();
        let bias = Tensor::f_cat(&biases, 0)?.f_unsqueeze(1)?;
        let output = bias.f_addmm(&weight, &cells)?;
        let anchors = self.scores.ws.size4()?.0;
        let scores = output.f_narrow(0, 0, anchors)?;
        let scores = scores.f_view([1, anchors, height, width])?;
        let offsets = output.f_narrow(0, anchors, BOX_CODE * anchors)?;
        let offsets = offsets.f_view([1, BOX_CODE * anchors, height, width])?;
        Ok(HeadOutput { scores, offsets })
    }
}

fn convolved(features: &Tensor, conv: &nn::Conv2D) -> Result<Tensor, TchError> {
    features.f_conv2d(&conv.ws, conv.bs.as_ref(), [1, 1], [0, 0], [1, 1], 1)
}

impl HeadOutput {
    /// Confidence of a vehicle around each cell: `[B, H, W]`, 0..1, the best of its anchors.
    pub fn confidence(&self) -> Tensor {
        // The sigmoid is increasing: the best logit gives the best probability.
        self.scores.amax([1], false).sigmoid().to_kind(Kind::Float)
    }
}

#[cfg(test)]
mod tests {
    use tch::Device;
    use tch::nn::VarStore;

    use super::*;

    #[test]
    fn one_product_gives_what_two_convolutions_give_in_either_memory_order() {
        let variables = VarStore::new(Device::Cpu);
        let head = DetectionHead::new(&variables.root(), 5, 2);
        let planes = Tensor::rand([1, 5, 6, 8], (Kind::Float, Device::Cpu));
        let expected = head.forward(&planes).unwrap();
        let cells = planes
            .permute([0, 2, 3, 1])
            .contiguous()
            .permute([0, 3, 1, 2]);
        for map in [planes, cells] {
            let found = head.forward_one(&map).unwrap();
            assert_eq!(found.offsets.size(), [1, 14, 6, 8]);
            assert!(found.scores.allclose(&expected.scores, 1e-5, 1e-6, false));
            assert!(found.offsets.allclose(&expected.offsets, 1e-5, 1e-6, false));
        }
        assert!(
            head.forward_one(&Tensor::zeros([1, 4, 6, 8], (Kind::Float, Device::Cpu)))
                .is_err()
        );
    }
}
