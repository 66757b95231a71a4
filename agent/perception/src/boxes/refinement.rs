//! Box refinement, the second stage of a detector: corrects each detected box from the features of its region of interest.
//!
//! The head of a fusion is trained for fused maps, and a 1x1 head sees one cell only. Boxes that a vehicle sends are
//! those of its own map, so they are refined before they are sent, where the weights have it.

use protocol::{Box3d, Detection};
use tch::nn::{self, Init, Module};
use tch::{Result, Tensor};

use crate::boxes::decode::sigmoid;
use crate::boxes::roi::{self, RoiEncoder};
use crate::model_config::{DetectorConfig, YAxis};
use crate::tensor_values::{tensor, values};
use crate::weights::Weights;

/// Prefix of its variables in a weights file.
pub const PREFIX: &str = "box_refinement.";
/// A variable that every box refinement has.
const WEIGHT: &str = "box_refinement.out.weight";
/// Numbers of a correction: along, across and up in lengths, widths and heights of the box, logarithms of sizes, heading in
/// radians, logit of the score.
pub const NUMBERS: usize = 8;
/// Numbers of a box that are read beside the map.
const VALUES: usize = 8;
/// Largest correction of a position in sizes of the box, of a logarithm, and of a heading in radians.
const MAX_CORRECTION: f64 = 0.5;
/// Scores are limited to this and its complement before their logit is taken.
const MIN_SCORE: f64 = 1e-4;

/// The network.
#[derive(Debug)]
pub struct BoxRefinement {
    roi: RoiEncoder,
    /// Zero at the start and without bias: an untrained refinement changes nothing.
    out: nn::Linear,
    /// Height of a usual vehicle's centre, metres.
    usual_z_m: f64,
    usual_size_m: [f64; 3],
    y_axis: YAxis,
}

/// True if a weights file has a box refinement.
pub fn is_in(weights: &Weights) -> bool {
    weights.contains(WEIGHT)
}

impl BoxRefinement {
    /// For maps of a detector; its variables are below `path`, `box_refinement.*`.
    pub fn new(path: &nn::Path<'_>, detector: &DetectorConfig) -> Self {
        let path = path / "box_refinement";
        let config = nn::LinearConfig {
            ws_init: Init::Const(0.0),
            bs_init: None,
            bias: false,
        };
        Self {
            roi: RoiEncoder::new(&path, detector, VALUES),
            out: nn::linear(&path / "out", roi::CHANNELS, NUMBERS as i64, config),
            usual_z_m: detector.anchors.center_z_m,
            usual_size_m: detector.anchors.size_lwh_m,
            y_axis: detector.y_axis,
        }
    }

    /// The detections of a map `[1, C, H, W]`, each corrected, by descending score.
    ///
    /// # Errors
    /// [`tch::TchError`] when the map is of another shape.
    pub fn refined(&self, map: &Tensor, detections: Vec<Detection>) -> Result<Vec<Detection>> {
        if detections.is_empty() {
            return Ok(detections);
        }
        let corrections = tch::no_grad(|| self.corrections(map, &detections))?;
        let mut refined = corrected(detections, &values(&corrections)?);
        refined.sort_by(|a, b| b.score.total_cmp(&a.score));
        Ok(refined)
    }

    /// `[N, NUMBERS]` corrections of the detections of a map `[1, C, H, W]`.
    ///
    /// # Errors
    /// As [`Self::refined`].
    pub fn corrections(&self, map: &Tensor, detections: &[Detection]) -> Result<Tensor> {
        let boxes = detections.iter().map(|detection| match self.y_axis {
            YAxis::Left => detection.box3d,
            YAxis::Right => detection.box3d.mirrored_y(),
        });
        let boxes: Vec<Box3d> = boxes.collect();
        let scored = boxes.iter().zip(detections);
        let all = scored.flat_map(|(box3d, detection)| self.values(box3d, detection.score));
        let all = tensor(&all.collect::<Vec<_>>(), &[-1, VALUES as i64], map.device())?;
        let hidden = self.roi.forward(map, &boxes, &all)?;
        let corrections = self.out.forward(&hidden);
        match self.y_axis {
            YAxis::Left => Ok(corrections),
            // Mirrored back: across and heading change their signs.
            YAxis::Right => {
                let signs: [f32; NUMBERS] = [1.0, -1.0, 1.0, 1.0, 1.0, 1.0, -1.0, 1.0];
                corrections.f_mul(&tensor(&signs, &[1, -1], map.device())?)
            }
        }
    }

    fn values(&self, box3d: &Box3d, score: f32) -> [f32; VALUES] {
        let [x_m, y_m, z_m] = box3d.center_m;
        let [length, width, height, sin, cos] = roi::shape(box3d, self.usual_size_m);
        // A logit is at most 9.2 in magnitude, so that all inputs stay within about 2.3 of zero.
        [
            logit(score) / 4.0,
            (x_m.hypot(y_m) / 50.0).min(2.0),
            ((z_m - self.usual_z_m) / self.usual_size_m[2]).clamp(-2.0, 2.0),
            sin,
            cos,
            length,
            width,
            height,
        ]
        .map(|value| value as f32)
    }
}

fn logit(score: f32) -> f64 {
    let score = f64::from(score).clamp(MIN_SCORE, 1.0 - MIN_SCORE);
    (score / (1.0 - score)).ln()
}

/// Detections with their corrections, `NUMBERS` each.
pub fn corrected(mut detections: Vec<Detection>, corrections: &[f32]) -> Vec<Detection> {
    for (detection, numbers) in detections.iter_mut().zip(corrections.chunks_exact(NUMBERS)) {
        let limited: [f64; 7] = std::array::from_fn(|index| {
            f64::from(numbers[index]).clamp(-MAX_CORRECTION, MAX_CORRECTION)
        });
        let found = &mut detection.box3d;
        let (center_m, size_m) = (&mut found.center_m, &mut found.size_m);
        let heading_rad = &mut found.heading_rad;
        let (sin, cos) = heading_rad.sin_cos();
        // In sizes of the uncorrected box, so positions come before sizes.
        let [along_m, across_m, up_m] = [0, 1, 2].map(|axis| limited[axis] * size_m[axis]);
        center_m[0] += cos * along_m - sin * across_m;
        center_m[1] += sin * along_m + cos * across_m;
        center_m[2] += up_m;
        for (axis, size_m) in size_m.iter_mut().enumerate() {
            *size_m *= limited[3 + axis].exp();
        }
        *heading_rad += limited[6];
        detection.score = sigmoid((logit(detection.score) + f64::from(numbers[7])) as f32);
    }
    detections
}

/// The correction that makes a box another one; its score stays. A heading and its opposite are the same box.
pub fn correction(from: &Box3d, to: &Box3d) -> [f64; NUMBERS] {
    let [dx, dy, dz] = [0, 1, 2].map(|axis| to.center_m[axis] - from.center_m[axis]);
    let (sin, cos) = from.heading_rad.sin_cos();
    let [length_m, width_m, height_m] = from.size_m;
    let along = (cos * dx + sin * dy) / length_m;
    let across = (cos * dy - sin * dx) / width_m;
    let [l, w, h] = [0, 1, 2].map(|axis| (to.size_m[axis] / from.size_m[axis]).ln());
    let turn = roi::within_quarter_turn(to.heading_rad - from.heading_rad);
    [along, across, dz / height_m, l, w, h, turn, 0.0]
}

/// True if no number of a correction is beyond the largest one.
pub fn is_within_limits(correction: &[f64; NUMBERS]) -> bool {
    let mut limited = correction[..7].iter();
    limited.all(|number| number.abs() <= MAX_CORRECTION)
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;
    use tch::nn::VarStore;
    use tch::{Device, Kind};

    use super::*;

    fn detection(center_m: [f64; 3], heading_rad: f64, score: f32) -> Detection {
        Detection {
            box3d: Box3d {
                center_m,
                size_m: [4.2, 1.8, 1.5],
                heading_rad,
            },
            score,
            source: None,
        }
    }

    fn detector(y_axis: YAxis) -> DetectorConfig {
        DetectorConfig {
            lidar_range_m: [-8.0, -8.0, -3.0, 8.0, 8.0, 1.0],
            y_axis,
            ..DetectorConfig::lean()
        }
    }

    #[test]
    fn an_untrained_one_changes_no_box() {
        let variables = VarStore::new(Device::Cpu);
        let refinement = BoxRefinement::new(&variables.root(), &detector(YAxis::Left));
        let map = Tensor::rand([1, 64, 20, 20], (Kind::Float, Device::Cpu));
        let found = vec![detection([1.0, 2.0, -1.0], 0.3, 0.9)];
        let refined = refinement.refined(&map, found.clone()).unwrap();
        assert_eq!(refined[0].box3d, found[0].box3d);
        assert!((refined[0].score - found[0].score).abs() < 1e-6);
        assert_eq!(refinement.refined(&map, Vec::new()).unwrap(), []);
    }

    /// Detections that a network of constant weights has refined.
    fn refined(y_axis: YAxis, map: &Tensor, found: Vec<Detection>) -> Vec<Detection> {
        let variables = VarStore::new(Device::Cpu);
        let refinement = BoxRefinement::new(&variables.root(), &detector(y_axis));
        tch::manual_seed(5);
        for (name, variable) in variables.variables() {
            let fan = if name.ends_with("out.weight") {
                0.1
            } else {
                0.05
            };
            let _ = tch::no_grad(|| variable.shallow_clone().fill_(fan));
        }
        refinement.refined(map, found).unwrap()
    }

    #[test]
    fn a_mirrored_network_corrects_the_mirrored_box() {
        tch::manual_seed(4);
        let map = Tensor::rand([1, 64, 20, 20], (Kind::Float, Device::Cpu));
        let found = detection([1.0, 2.0, -1.0], 0.3, 0.9);
        let mirrored = Detection {
            box3d: found.box3d.mirrored_y(),
            ..found.clone()
        };
        let left = refined(YAxis::Left, &map, vec![mirrored]);
        let right = refined(YAxis::Right, &map, vec![found.clone()]);
        let back = left[0].box3d.mirrored_y();
        for axis in 0..3 {
            assert!((right[0].box3d.center_m[axis] - back.center_m[axis]).abs() < 1e-5);
        }
        assert!((right[0].box3d.heading_rad - back.heading_rad).sin().abs() < 1e-5);
        assert_ne!(right[0].box3d, found.box3d);
    }

    proptest! {
        #[test]
        fn the_correction_to_a_box_in_reach_leads_there(
            off in prop::array::uniform7(-0.3_f64..0.3), heading_rad in -4.0_f64..4.0, opposite in any::<bool>(),
        ) {
            let from = detection([10.0, -5.0, -1.0], heading_rad, 0.7);
            let [along, across, up, length, width, height, turn] = off;
            let numbers = [along, across, up, length, width, height, turn, 0.0].map(|number| number as f32);
            let mut to = corrected(vec![from.clone()], &numbers).remove(0).box3d;
            if opposite {
                to.heading_rad += std::f64::consts::PI;
            }
            let found = correction(&from.box3d, &to);
            prop_assert!(is_within_limits(&found));
            for (found, number) in found.into_iter().zip(numbers) {
                prop_assert!((found - f64::from(number)).abs() < 1e-5);
            }
        }
    }
}
