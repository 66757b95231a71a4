//! Placed boxes: neighbours' detections in the frame of the ego, and the support of each by other senders.

use std::collections::BTreeMap;

use protocol::rotated_iou::Polygon;
use protocol::{Box3d, Detection, Pose};

/// A neighbour's box in the frame of the ego.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PlacedBox {
    /// The box.
    pub box3d: Box3d,
    /// Number of its sender among those of the frame.
    pub sender: usize,
    /// Age relative to the ego's frame, seconds.
    pub age_secs: f64,
    /// Score of the detection, 0..1.
    pub score: f64,
    /// Confidence of the sender's pose, 0..1.
    pub pose_confidence: f64,
}

/// The detections of a sender in the frame of the ego, the highest score first; `pose_confidence` is that of its pose.
pub fn placed<'a>(
    detections: impl Iterator<Item = &'a Detection>,
    ego_from_cav: &Pose,
    sender: usize,
    age_secs: f64,
    pose_confidence: f64,
) -> Vec<PlacedBox> {
    let ego_from_cav = ego_from_cav.isometry();
    let boxes = detections.map(|detection| PlacedBox {
        box3d: detection.box3d.transformed(&ego_from_cav),
        sender,
        age_secs,
        score: f64::from(detection.score),
        pose_confidence,
    });
    let mut boxes: Vec<PlacedBox> = boxes.collect();
    boxes.sort_by(|a, b| b.score.total_cmp(&a.score));
    boxes
}

/// Support of each box by other senders: the sum over them of the largest product of BEV IoU and confidence.
pub(super) fn support(boxes: &[PlacedBox]) -> Vec<f64> {
    let footprints: Vec<Polygon> = boxes
        .iter()
        .map(|placed| Polygon::footprint(&placed.box3d.corners()))
        .collect();
    let by_box = boxes.iter().zip(&footprints).map(|(own, footprint)| {
        let mut by_sender = BTreeMap::new();
        for (other, overlapping) in boxes.iter().zip(&footprints) {
            if other.sender != own.sender {
                let iou = footprint.iou(overlapping);
                // One value per sender: a sender that repeats a box adds no further support.
                let best: &mut f64 = by_sender.entry(other.sender).or_default();
                *best = best.max(iou * (other.score * other.pose_confidence));
            }
        }
        by_sender.values().sum::<f64>()
    });
    by_box.collect()
}

#[cfg(test)]
mod tests {
    use std::f64::consts::FRAC_PI_2;

    use super::*;

    fn car(sender: usize, x_m: f64, score: f64) -> PlacedBox {
        PlacedBox {
            box3d: Box3d {
                center_m: [x_m, 0.0, -1.0],
                size_m: [4.0, 1.6, 1.5],
                heading_rad: 0.0,
            },
            sender,
            age_secs: 0.0,
            score,
            pose_confidence: 0.5,
        }
    }

    #[test]
    fn support_is_overlap_and_confidence_of_other_senders_only() {
        let boxes = [
            car(1, 0.0, 0.8),
            car(1, 0.0, 0.9),
            car(2, 0.0, 0.6),
            car(3, 2.0, 1.0),
            car(3, 20.0, 1.0),
        ];
        let found = support(&boxes);
        // Half a length apart: a third of the union.
        assert!((found[0] - (0.3 + 0.5 / 3.0)).abs() < 1e-9, "{found:?}");
        assert!((found[2] - (0.45 + 0.5 / 3.0)).abs() < 1e-9, "{found:?}");
        assert_eq!(found[4], 0.0);
    }

    #[test]
    fn boxes_are_placed_by_the_pose_of_their_sender() {
        let detection = Detection {
            box3d: car(0, 4.0, 0.8).box3d,
            score: 0.8,
            source: None,
        };
        let best = Detection {
            score: 0.9,
            ..detection.clone()
        };
        let pose = Pose::from_xyz_yaw([1.0, 2.0, 0.0], FRAC_PI_2);
        let both = [&detection, &best].into_iter();
        let [first, placed] = placed(both, &pose, 3, 0.2, 0.5)[..] else {
            panic!("two boxes");
        };
        assert!(first.score > placed.score);
        let [x, y, _] = placed.box3d.center_m;
        assert!((x - 1.0).abs() < 1e-9 && (y - 6.0).abs() < 1e-9);
        assert!((placed.box3d.heading_rad - FRAC_PI_2).abs() < 1e-9);
        assert_eq!(placed.sender, 3);
    }
}
