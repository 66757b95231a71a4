//! Detection loss: sigmoid focal loss on scores, smooth L1 on boxes with the sine of the yaw difference.
//!
//! As PointPillars and OpenCOOD define it: per sample divided by its number of positives (at least one), summed,
//! divided by the batch size.

use perception::tensor_values::tensor;
use tch::{Device, Kind, Result, Tensor};

use crate::samples::PoseOffset;
use fusion::targets::{BOX_CODE, Labels};

/// Weight of a rotation by a radian relative to a shift by a metre: about the distance of objects that two neighbours
/// share.
const METRES_PER_RADIAN: f64 = 20.0;
/// Remaining pose errors beyond this are out of the range of FSA and not trained, metres.
const RECOVERABLE_M: f64 = 5.0;

/// Focal loss: share of the positives.
pub const ALPHA: f64 = 0.25;
/// Focal loss: exponent that reduces the weight of easy anchors.
pub const GAMMA: f64 = 2.0;
/// Smooth L1: end of the quadratic part.
pub const BETA: f64 = 1.0 / 9.0;
/// Weight of the classification term.
pub const SCORE_WEIGHT: f64 = 1.0;
/// Weight of the regression term.
pub const BOX_WEIGHT: f64 = 2.0;

/// Settings of the loss of a training.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct LossConfig {
    /// Weight of the alignment term: the difference of a fusion's own pose corrections from the errors that were added.
    /// 0: only the detection loss trains the alignment, as in the paper.
    pub alignment_weight: f64,
    /// Treatment of unassigned anchors.
    pub unassigned: Unassigned,
}

/// Treatment of anchors between the two overlap thresholds.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Unassigned {
    /// They count as background: the behaviour of OpenCOOD.
    #[default]
    Background,
    /// They are ignored: the intention of its label generator.
    Ignored,
}

/// The terms of the loss, each a scalar tensor that carries its gradient.
#[derive(Debug)]
pub struct Loss {
    /// Weighted classification term.
    pub score: Tensor,
    /// Weighted regression term.
    pub boxes: Tensor,
}

impl Loss {
    /// The minimised sum.
    pub fn total(&self) -> Tensor {
        &self.score + &self.boxes
    }
}

/// Labels of a batch as tensors on the device of the network.
#[derive(Debug)]
pub struct LabelTensors {
    /// `[B, H*W*A]` 1 at positives.
    positive: Tensor,
    /// `[B, H*W*A]` weight of every anchor in the classification term.
    score_weight: Tensor,
    /// `[P]` flat indices of positives into `B*H*W*A`.
    index: Tensor,
    /// `[P, 7]` targets.
    code: Tensor,
    /// `[P]` weight of every positive in the regression term.
    box_weight: Tensor,
}

impl LabelTensors {
    /// Gathers the labels of a batch; every sample has the same number of anchors.
    pub fn gather(samples: &[Labels], unassigned: Unassigned, device: Device) -> Self {
        let anchors = samples.first().map_or(0, |labels| labels.anchors);
        let mut positive = vec![0f32; anchors * samples.len()];
        let mut score_weight = vec![0f32; anchors * samples.len()];
        let (mut index, mut code, mut box_weight) = (Vec::new(), Vec::new(), Vec::new());
        for (sample, labels) in samples.iter().enumerate() {
            let first = sample * anchors;
            // Every sample has the same weight, however many objects are in it.
            let weight = 1.0 / labels.positives.len().max(1) as f32;
            score_weight[first..first + anchors].fill(weight);
            if unassigned == Unassigned::Ignored {
                for &anchor in &labels.unassigned {
                    score_weight[first + anchor] = 0.0;
                }
            }
            for entry in &labels.positives {
                positive[first + entry.anchor] = 1.0;
                index.push((first + entry.anchor) as i64);
                code.extend(entry.code.map(|value| value as f32));
                box_weight.push(weight);
            }
        }
        let shape = [samples.len() as i64, anchors as i64];
        let positives = index.len() as i64;
        let [positive, score_weight] =
            [positive, score_weight].map(|values| Tensor::from_slice(&values).view(shape));
        let code = Tensor::from_slice(&code).view([positives, BOX_CODE as i64]);
        Self {
            positive: positive.to_device(device),
            score_weight: score_weight.to_device(device),
            code: code.to_device(device),
            index: Tensor::from_slice(&index).to_device(device),
            box_weight: Tensor::from_slice(&box_weight).to_device(device),
        }
    }
}

/// The loss of a batch.
///
/// # Shapes
/// - `scores`: `[B, A, H, W]` logits
/// - `boxes`: `[B, 7A, H, W]`, channel `7 * anchor + component`
///
/// # Errors
/// [`tch::TchError`] when the maps do not fit the labels.
pub fn detection_loss(scores: &Tensor, boxes: &Tensor, labels: &LabelTensors) -> Result<Loss> {
    let batch = scores.size()[0].max(1) as f64;
    let score = focal_loss(scores, labels)?.f_sum(Kind::Float)?;
    let boxes = box_loss(boxes, labels)?.f_sum(Kind::Float)?;
    Ok(Loss {
        score: score * (SCORE_WEIGHT / batch),
        boxes: boxes * (BOX_WEIGHT / batch),
    })
}

/// Difference of corrections from those that undo the added pose errors: smooth L1 per view, mean over views and
/// samples.
///
/// A rotation by a radian counts as a shift by 20 m. No true pose is used: an added error is known whatever the pose it
/// was added to. Where more than 5 m are left the term is zero: such a map was not found by the search.
///
/// # Errors
/// [`tch::TchError`] when a sample has other views than offsets.
pub(crate) fn alignment_loss(
    corrections: &[Option<Tensor>],
    offsets: &[Vec<PoseOffset>],
) -> Result<Tensor> {
    let unit = Tensor::f_from_slice(&[1.0, 1.0, METRES_PER_RADIAN as f32])?;
    let mut losses = Vec::new();
    for (moved_by, offsets) in corrections.iter().zip(offsets) {
        let Some(moved_by) = moved_by else { continue };
        let device = moved_by.device();
        let of_others = offsets.iter().skip(1);
        let wanted = of_others.flat_map(|PoseOffset(offset)| offset.map(|value| value as f32));
        let wanted = tensor(&wanted.collect::<Vec<f32>>(), &[-1, 3], device)?;
        let off = (moved_by.f_to_kind(Kind::Float)? - wanted) * unit.f_to_device(device)?;
        // The largest of the three decides about a view as a whole.
        let left_m = off.f_abs()?.f_amax([1_i64].as_slice(), true)?;
        let off = off * left_m.f_le(RECOVERABLE_M)?;
        losses.push(off.f_smooth_l1_loss(&off.f_zeros_like()?, tch::Reduction::Mean, 1.0)?);
    }
    match losses.as_slice() {
        [] => Tensor::f_zeros([], (Kind::Float, Device::Cpu)),
        _ => Tensor::f_stack(&losses, 0)?.f_mean(Kind::Float),
    }
}

/// Weighted focal loss of every anchor, `[B, H*W*A]`.
fn focal_loss(scores: &Tensor, labels: &LabelTensors) -> Result<Tensor> {
    let target = &labels.positive;
    // Labels have the anchors of a cell next to each other: `[B, H, W, A]`.
    let logits = scores.f_to_kind(Kind::Float)?.f_permute([0, 2, 3, 1])?;
    let logits = logits.f_reshape(target.size())?;
    let probability = logits.f_sigmoid()?;
    let background: Tensor = 1.0 - target;
    // 1 - p_t of the paper: error of the prediction.
    let wrong: Tensor = target * (1.0 - &probability) + &background * &probability;
    let balance = target * ALPHA + &background * (1.0 - ALPHA);
    let (none, each) = (None::<&Tensor>, tch::Reduction::None);
    let entropy = logits.f_binary_cross_entropy_with_logits(target, none, none, each)?;
    Ok(balance * wrong.f_pow_tensor_scalar(GAMMA)? * entropy * &labels.score_weight)
}

/// Weighted smooth L1 of every positive, `[P, 7]`.
fn box_loss(boxes: &Tensor, labels: &LabelTensors) -> Result<Tensor> {
    let code = BOX_CODE as i64;
    let predicted = boxes.f_permute([0, 2, 3, 1])?.f_reshape([-1, code])?;
    let predicted = predicted.f_index_select(0, &labels.index)?;
    let difference = predicted.f_to_kind(Kind::Float)? - &labels.code;
    let linear = difference.f_narrow(1, 0, code - 1)?;
    // The sine is 0 for a heading and its opposite: a box turned by half a circle is the same box.
    let turn = difference.f_narrow(1, code - 1, 1)?.f_sin()?;
    let distance = Tensor::f_cat(&[linear, turn], 1)?.f_abs()?;
    let squared = distance.f_square()? * (0.5 / BETA);
    let above = &distance - 0.5 * BETA;
    let loss = squared.f_where_self(&distance.f_lt(BETA)?, &above)?;
    Ok(loss * labels.box_weight.f_unsqueeze(1)?)
}

#[cfg(test)]
mod tests {
    use super::*;
    use fusion::targets::Positive;

    fn labels(positives: Vec<Positive>, unassigned: Vec<usize>) -> Labels {
        Labels {
            anchors: 2 * 3 * 2,
            positives,
            unassigned,
        }
    }

    fn loss(
        scores: &Tensor,
        boxes: &Tensor,
        labels: &[Labels],
        unassigned: Unassigned,
    ) -> (f64, f64) {
        let tensors = LabelTensors::gather(labels, unassigned, Device::Cpu);
        let loss = detection_loss(scores, boxes, &tensors).unwrap();
        (loss.score.double_value(&[]), loss.boxes.double_value(&[]))
    }

    fn alignment_term(corrections: &[Option<Tensor>], offsets: &[Vec<PoseOffset>]) -> f64 {
        let loss = alignment_loss(corrections, offsets).unwrap();
        loss.double_value(&[])
    }

    fn maps() -> (Tensor, Tensor) {
        let options = (Kind::Float, Device::Cpu);
        (
            Tensor::zeros([1, 2, 2, 3], options),
            Tensor::zeros([1, 14, 2, 3], options),
        )
    }

    #[test]
    fn an_undecided_map_costs_its_entropy() {
        let (scores, boxes) = maps();
        let (score, regression) = loss(
            &scores,
            &boxes,
            &[labels(vec![], vec![])],
            Unassigned::Background,
        );
        // Twelve negatives at p = 1/2: 0.75 * (1/2)^2 * ln 2 each.
        assert!((score - 12.0 * 0.75 * 0.25 * 2f64.ln()).abs() < 1e-5);
        assert_eq!(regression, 0.0);
    }

    #[test]
    fn unassigned_anchors_count_only_where_asked() {
        let (scores, boxes) = maps();
        let sample = [labels(vec![], vec![3, 4])];
        let as_background = loss(&scores, &boxes, &sample, Unassigned::Background).0;
        let ignored = loss(&scores, &boxes, &sample, Unassigned::Ignored).0;
        assert!((ignored / as_background - 10.0 / 12.0).abs() < 1e-5);
    }

    #[test]
    fn the_alignment_term_is_zero_where_errors_are_undone_and_weighs_turns_by_an_arm() {
        let offsets = vec![vec![
            PoseOffset::default(),
            PoseOffset([1.0, -0.5, 0.02]),
            PoseOffset([0.0, 2.0, 0.0]),
        ]];
        let undone = Tensor::from_slice(&[1.0f32, -0.5, 0.02, 0.0, 2.0, 0.0]).view([2, 3]);
        assert!(alignment_term(&[Some(undone)], &offsets) < 1e-12);
        // No correction: |1|, |-0.5|, 20 m * |0.02|, |2| by smooth L1, over six numbers.
        let still = Tensor::zeros([2, 3], (Kind::Float, Device::Cpu)).set_requires_grad(true);
        let expected = (0.5 + 0.125 + 0.08 + 1.5) / 6.0;
        let found = alignment_term(&[Some(still.shallow_clone())], &offsets);
        assert!((found - expected).abs() < 1e-6);
        alignment_loss(
            &[Some(still.shallow_clone()), None],
            &[offsets[0].clone(), vec![]],
        )
        .unwrap()
        .backward();
        assert!(
            still.grad().double_value(&[0, 0]) < 0.0,
            "towards the offset"
        );
        let lost = vec![vec![
            PoseOffset::default(),
            PoseOffset([9.0, 0.0, 0.0]),
            PoseOffset([0.0, 0.0, 1.0]),
        ]];
        assert_eq!(
            alignment_term(&[Some(still.detach())], &lost),
            0.0,
            "a lost vehicle has no alignment loss"
        );
        assert_eq!(
            alignment_term(&[None], &[vec![PoseOffset::default()]]),
            0.0,
            "ego-only there is nothing to align"
        );
    }

    #[test]
    fn the_box_term_reads_the_channels_of_its_anchor() {
        let (scores, mut boxes) = maps();
        // Row 1, column 2, anchor 1.
        let positive = Positive {
            anchor: (3 + 2) * 2 + 1,
            code: [0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 3.0],
        };
        let _ = boxes.get(0).get(7 + 4).get(1).get(2).fill_(1.0);
        let _ = boxes.get(0).get(7 + 6).get(1).get(2).fill_(3.0);
        let (_, regression) = loss(
            &scores,
            &boxes,
            &[labels(vec![positive], vec![])],
            Unassigned::Background,
        );
        assert!(regression.abs() < 1e-6);
        let _ = boxes.get(0).get(7).get(1).get(2).fill_(1.0);
        let (_, regression) = loss(
            &scores,
            &boxes,
            &[labels(vec![positive], vec![])],
            Unassigned::Background,
        );
        assert!((regression - 2.0 * (1.0 - 0.5 / 9.0)).abs() < 1e-5);
        let _ = boxes.fill_(0.0);
    }
}
