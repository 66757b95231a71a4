//! Refined boxes in samples: a vehicle's own detections after the refinement, and the loss against the ground truth.

use dataset::ground_truth::GroundTruth;
use fusion::model::CooperativeModel;
use perception::boxes::postprocess::PostprocessConfig;
use perception::boxes::refinement::{NUMBERS, corrected, correction, is_within_limits};
use perception::tensor_values::{tensor, values};
use protocol::rotated_iou::Polygon;
use protocol::{Box3d, Detection, Pose};
use tch::{Device, Kind, Reduction, Tensor};

use crate::Error;

/// Least IoU from above of a detection with the object that it is corrected to.
const LEAST_IOU: f64 = 0.25;
/// IoU of a corrected box from which on its score should be above 0, and at which it should be 1.
const SCORED_IOU: [f64; 2] = [0.3, 0.7];
/// Numbers of a correction beside the score.
const OF_BOX: i64 = NUMBERS as i64 - 1;
/// Smooth L1: end of the quadratic part.
const BETA: f64 = 0.05;
/// Weight of the boxes beside the scores.
const BOX_WEIGHT: f64 = 10.0;

/// Detections of a vehicle from its own map `[1, C, H, W]`, in its own LiDAR frame, refined if the model does, and the loss
/// of the refinement; absent without one.
pub(super) fn refined_boxes(
    model: &CooperativeModel,
    map: &Tensor,
    ego_from_cav: &Pose,
    truth: &GroundTruth,
) -> Result<(Vec<Detection>, Option<Tensor>), Error> {
    let limits = PostprocessConfig::for_late_fusion(model.config());
    let heads = tch::no_grad(|| model.network.heads(map))?;
    let found = model.detections(&heads, &limits)?.pop().unwrap_or_default();
    let Some(refinement) = model.refinement.as_ref().filter(|_| !found.is_empty()) else {
        return Ok((found, None));
    };
    let corrections = refinement.corrections(map, &found)?;
    // Plain numbers: no gradient flows through the IoU of a corrected box.
    let mut refined = corrected(found.clone(), &values(&corrections)?);
    let targets = Targets::new(&found, &refined, ego_from_cav, truth);
    let loss = targets.loss(&corrections, &found)?;
    refined.retain(|detection| detection.score > limits.score_threshold);
    Ok((refined, Some(loss)))
}

/// Targets of the refinement for the detections of a vehicle: corrections and scores.
#[derive(Debug, Default)]
struct Targets {
    /// `[N, OF_BOX]`.
    corrections: Vec<f32>,
    /// `[N]`: 1 for a detection of an object.
    is_object: Vec<f32>,
    /// `[N]`: score of the corrected box.
    score: Vec<f32>,
    /// `[N]`: 1 where the truth is known.
    is_known: Vec<f32>,
}

impl Targets {
    fn new(
        found: &[Detection],
        refined: &[Detection],
        ego_from_cav: &Pose,
        truth: &GroundTruth,
    ) -> Self {
        let ego_from_cav = ego_from_cav.isometry();
        let cav_from_ego = ego_from_cav.inverse();
        let objects = truth.boxes().map(|of| of.transformed(&cav_from_ego));
        let objects: Vec<Box3d> = objects.collect();
        let footprints = objects.iter().map(|of| Polygon::footprint(&of.corners()));
        let footprints: Vec<Polygon> = footprints.collect();
        let mut targets = Self::default();
        for (detection, refined) in found.iter().zip(refined) {
            let object = overlapped(&detection.box3d, &footprints);
            let object = object.filter(|(_, iou)| *iou >= LEAST_IOU);
            let wanted = object.map(|(index, _)| correction(&detection.box3d, &objects[index]));
            // A correction beyond the limits cannot be applied: its detection counts as one of no object.
            let wanted = wanted.filter(is_within_limits);
            let numbers = wanted.unwrap_or_default();
            let numbers = numbers[..OF_BOX as usize].iter();
            targets.corrections.extend(numbers.map(|at| *at as f32));
            targets.is_object.push(f32::from(wanted.is_some()));
            let [least, most] = SCORED_IOU;
            // The score is that of the box after its correction.
            let iou = overlapped(&refined.box3d, &footprints).map_or(0.0, |(_, iou)| iou);
            let score = ((iou - least) / (most - least)).clamp(0.0, 1.0);
            targets.score.push(score as f32);
            let [x, y, _] = detection.box3d.transformed(&ego_from_cav).center_m;
            // Objects beyond the area are not in the truth: nothing can be said about detections there.
            let [x0, y0, x1, y1] = truth.area_m;
            let is_known = (x0..=x1).contains(&x) && (y0..=y1).contains(&y);
            targets.is_known.push(f32::from(is_known));
        }
        targets
    }

    /// Smooth L1 of the boxes of objects and cross entropy of the scores, both divided by the number of detections.
    fn loss(&self, corrections: &Tensor, found: &[Detection]) -> tch::Result<Tensor> {
        let device = corrections.device();
        let wanted = tensor(&self.corrections, &[-1, OF_BOX], device)?;
        let off = corrections.f_narrow(1, 0, OF_BOX)?;
        let boxes = off.f_smooth_l1_loss(&wanted, Reduction::None, BETA)?;
        let is_object = column(&self.is_object, device)?;
        let boxes = boxes.f_mul(&is_object)?.f_sum(Kind::Float)?;
        // Scores of exactly 0 or 1 have no finite logit.
        let before = found.iter().map(|it| it.score.clamp(1e-4, 1.0 - 1e-4));
        let before: Vec<f32> = before.collect();
        // A score is corrected by a sum of logits, as in inference.
        let logit = column(&before, device)?.f_logit(None)? + corrections.f_narrow(1, OF_BOX, 1)?;
        let (none, each) = (None::<&Tensor>, Reduction::None);
        let score = column(&self.score, device)?;
        let scores = logit.f_binary_cross_entropy_with_logits(&score, none, none, each)?;
        let is_known = column(&self.is_known, device)?;
        let scores = scores.f_mul(&is_known)?.f_sum(Kind::Float)?;
        Ok((boxes * BOX_WEIGHT + scores) / found.len().max(1) as f64)
    }
}

/// Index of the object with the largest IoU from above, and that IoU.
fn overlapped(box3d: &Box3d, objects: &[Polygon]) -> Option<(usize, f64)> {
    let own = Polygon::footprint(&box3d.corners());
    let overlaps = objects.iter().map(|object| own.iou(object));
    overlaps.enumerate().max_by(|(_, a), (_, b)| a.total_cmp(b))
}

fn column(values: &[f32], device: Device) -> tch::Result<Tensor> {
    tensor(values, &[-1, 1], device)
}

#[cfg(test)]
mod tests {
    use dataset::frame::ObjectClass;
    use dataset::ground_truth::TrueBox;

    use super::*;

    fn detection(x_m: f64, y_m: f64) -> Detection {
        Detection {
            box3d: Box3d {
                center_m: [x_m, y_m, -1.0],
                size_m: [4.0, 1.8, 1.5],
                heading_rad: 0.0,
            },
            score: 0.5,
            source: None,
        }
    }

    #[test]
    fn detections_are_corrected_to_their_objects_and_others_lose_their_score() {
        let ego_from_cav = Pose::from_xyz_yaw([10.0, 0.0, 0.0], 0.0);
        let object = TrueBox {
            box3d: detection(15.0, 0.2).box3d,
            id: 1,
            class: ObjectClass::Car,
        };
        let truth = GroundTruth {
            objects: vec![object],
            ignored: Vec::new(),
            area_m: [-50.0, -40.0, 50.0, 40.0],
        };
        // On the object but for 0.4 and 0.2 m, of nothing, and beyond the area.
        let found = [
            detection(4.6, 0.0),
            detection(-20.0, 0.0),
            detection(60.0, 0.0),
        ];
        let refined = [detection(5.0, 0.2), found[1].clone(), found[2].clone()];
        let targets = Targets::new(&found, &refined, &ego_from_cav, &truth);
        assert_eq!(targets.is_object, [1.0, 0.0, 0.0]);
        assert_eq!(targets.is_known, [1.0, 1.0, 0.0]);
        assert_eq!(targets.score, [1.0, 0.0, 0.0]);
        assert!((targets.corrections[0] - 0.1).abs() < 1e-6);
        assert!((targets.corrections[1] - 0.2 / 1.8).abs() < 1e-6);
        // Right corrections leave the scores alone: -ln(1/2) twice, over three detections.
        let mut right = vec![0.0; 3 * NUMBERS];
        right[..OF_BOX as usize].copy_from_slice(&targets.corrections[..OF_BOX as usize]);
        let corrections = Tensor::from_slice(&right).view([3, NUMBERS as i64]);
        let loss = targets
            .loss(&corrections, &found)
            .unwrap()
            .double_value(&[]);
        assert!((loss - 2.0 * 2_f64.ln() / 3.0).abs() < 1e-5, "{loss}");
    }
}
