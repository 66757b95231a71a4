//! Post-processing: from decoded boxes of one or more agents to detections.

use nalgebra::{Isometry3, Point3};
use protocol::rotated_iou::Polygon;
use protocol::{Box3d, CavId, Detection, corners_within};

use crate::boxes::decode::Decoded;
use crate::boxes::nms::rotated_nms;
use crate::model_config::DetectorConfig;

/// Score at or below which boxes are not evaluated. It is the same for every method: for a box that a vehicle sends and
/// for one that the ego detects in a fused feature map.
pub const SCORE_THRESHOLD: f32 = 0.1;

/// Limits of post-processing. Defaults are those of the reference, except the score threshold, which is common to all
/// methods here.
#[derive(Debug, Clone, PartialEq)]
pub struct PostprocessConfig {
    /// Score at or below which anchors are no candidates.
    pub score_threshold: f32,
    /// IoU seen from above; a box is removed if a better one overlaps it more.
    pub nms_iou: f64,
    /// Largest number of candidates of the suppression.
    pub nms_max_candidates: usize,
    /// Longest axis-aligned side of a box, metres; longer ones are removed.
    pub max_extent_m: f64,
    /// Heights that all corners must lie between, metres in the output frame.
    pub z_range_m: [f64; 2],
    /// Area that all corners must lie in: x, y of the lower, then of the upper corner, metres in the output frame.
    pub keep_range_m: [f64; 4],
}

impl Default for PostprocessConfig {
    fn default() -> Self {
        Self {
            score_threshold: SCORE_THRESHOLD,
            nms_iou: 0.15,
            nms_max_candidates: 1000,
            max_extent_m: 6.0,
            z_range_m: [-3.0, 1.0],
            keep_range_m: [-140.0, -40.0, 140.0, 40.0],
        }
    }
}

impl PostprocessConfig {
    /// The default numbers with the range of a detector instead of the fixed one.
    pub fn for_detector(config: &DetectorConfig) -> Self {
        let [x_low, y_low, z_low, x_high, y_high, z_high] = config.lidar_range_m;
        Self {
            z_range_m: [z_low, z_high],
            keep_range_m: [x_low, y_low, x_high, y_high],
            ..Self::default()
        }
    }

    /// For boxes that another vehicle will merge: the receiver applies its own range.
    pub fn for_late_fusion(config: &DetectorConfig) -> Self {
        Self {
            keep_range_m: [f64::MIN, f64::MIN, f64::MAX, f64::MAX],
            ..Self::for_detector(config)
        }
    }
}

/// A box by its corners: after a transform with roll or pitch it is not upright any more.
#[derive(Debug, Clone, PartialEq)]
pub struct Candidate {
    /// Corners in the order of [`Box3d::corners`], metres in the output frame.
    pub corners: [[f64; 3]; 8],
    /// Confidence, 0..1.
    pub score: f32,
    /// Index of its agent.
    pub agent: usize,
}

/// Decoded boxes of one agent, and the transform of its frame to that of the output.
#[derive(Debug, Clone, Copy)]
pub struct AgentBoxes<'a> {
    /// Decoded boxes above the score threshold.
    pub boxes: &'a [Decoded],
    /// Transforms points of the boxes' frame to the output frame.
    pub output_from_agent: Isometry3<f64>,
}

/// Detections of one agent in its own frame, by descending score.
pub fn detections(boxes: &[Decoded], config: &PostprocessConfig) -> Vec<Detection> {
    let own = AgentBoxes {
        boxes,
        output_from_agent: Isometry3::identity(),
    };
    let found = postprocess(&[own], config).into_iter();
    found.map(|candidate| candidate.detection(None)).collect()
}

/// The whole chain: projects, removes boxes of implausible size, suppresses, removes boxes out of range.
///
/// Returns the detections by descending score.
pub fn postprocess(agents: &[AgentBoxes<'_>], config: &PostprocessConfig) -> Vec<Candidate> {
    let mut candidates = Vec::new();
    for (agent, boxes) in agents.iter().enumerate() {
        for decoded in boxes.boxes {
            candidates.push(Candidate {
                corners: (decoded.box3d.corners())
                    .map(|corner| (boxes.output_from_agent * Point3::from(corner)).into()),
                score: decoded.score,
                agent,
            });
        }
    }
    // Before the suppression: an implausible box must not remove a good one.
    candidates.retain(|candidate| is_vehicle_sized(&candidate.corners, config));
    let mut kept = suppress(&candidates, config);
    // After the suppression: a box beyond the range still removes those that it overlaps.
    kept.retain(|candidate| corners_within(&candidate.corners, config.keep_range_m));
    kept
}

/// True if the size and height are plausible for a vehicle: no side over the limit, not flat, all corners between the
/// heights.
pub fn is_vehicle_sized(corners: &[[f64; 3]; 8], config: &PostprocessConfig) -> bool {
    // Lowest and highest x, y, z.
    let [x, y, z]: [[f64; 2]; 3] = std::array::from_fn(|axis| {
        let values = corners.iter().map(|corner| corner[axis]);
        let low = values.clone().fold(f64::INFINITY, f64::min);
        [low, values.fold(f64::NEG_INFINITY, f64::max)]
    });
    let [x_m, y_m, z_m] = [x, y, z].map(|[low, high]| high - low);
    let sized = x_m <= config.max_extent_m && y_m <= config.max_extent_m && z_m > 0.0;
    sized && z[0] >= config.z_range_m[0] && z[1] <= config.z_range_m[1]
}

/// Rotated non-maximum suppression on the footprints, by descending score.
pub fn suppress(candidates: &[Candidate], config: &PostprocessConfig) -> Vec<Candidate> {
    let (polygons, scores): (Vec<Polygon>, Vec<f32>) = (candidates.iter())
        .map(|candidate| (Polygon::footprint(&candidate.corners), candidate.score))
        .unzip();
    let (iou, most) = (config.nms_iou, config.nms_max_candidates);
    let kept = rotated_nms(&polygons, &scores, iou, most).into_iter();
    kept.map(|index| candidates[index].clone()).collect()
}

/// The upright box of eight corners.
///
/// Centre and sizes are means over the corners and the parallel edges. The heading is the direction of the sum of the
/// four edges along the length: unlike a mean of four angles it is continuous at half a turn.
pub fn corners_to_box(corners: &[[f64; 3]; 8]) -> Box3d {
    let center_m =
        std::array::from_fn(|axis| corners.iter().map(|corner| corner[axis]).sum::<f64>() / 8.0);
    let edge =
        |from: usize, to: usize| [0, 1].map(|axis: usize| corners[to][axis] - corners[from][axis]);
    // Edges from rear to front, then from right to left, in the order of `Box3d::corners`.
    let along = [edge(3, 0), edge(2, 1), edge(7, 4), edge(6, 5)];
    let across = [edge(0, 1), edge(3, 2), edge(4, 5), edge(7, 6)];
    let heights = (0..4).map(|corner| (corners[corner + 4][2] - corners[corner][2]).abs());
    let height = heights.sum::<f64>() / 4.0;
    let [length, width] =
        [along, across].map(|edges| edges.iter().map(|[x, y]| x.hypot(*y)).sum::<f64>() / 4.0);
    let [x, y] = [0, 1].map(|axis: usize| along.iter().map(|edge| edge[axis]).sum::<f64>());
    Box3d {
        center_m,
        size_m: [length, width, height],
        heading_rad: y.atan2(x),
    }
}

impl Candidate {
    /// The published detection. `source` is the CAV if one alone detected it.
    pub fn detection(&self, source: Option<CavId>) -> Detection {
        Detection {
            box3d: corners_to_box(&self.corners),
            score: self.score,
            source,
        }
    }
}

#[cfg(test)]
mod tests {
    use std::f64::consts::PI;

    use nalgebra::Vector3;

    use super::*;

    const CAR: Box3d = Box3d {
        center_m: [10.0, 2.0, -1.0],
        size_m: [4.0, 2.0, 1.5],
        heading_rad: 0.3,
    };

    fn decoded(box3d: Box3d, score: f32) -> Decoded {
        Decoded {
            anchor: 0,
            score,
            box3d,
        }
    }

    fn run(boxes: &[Decoded]) -> Vec<Candidate> {
        let agent = AgentBoxes {
            boxes,
            output_from_agent: Isometry3::identity(),
        };
        postprocess(&[agent], &PostprocessConfig::default())
    }

    #[test]
    fn corners_give_the_box_back_at_any_heading() {
        for heading_rad in [0.3, -2.0, PI, -PI + 1e-7, PI - 1e-7] {
            let back = corners_to_box(&Box3d { heading_rad, ..CAR }.corners());
            let turn = (back.heading_rad - heading_rad).rem_euclid(2.0 * PI);
            assert!(
                turn.min(2.0 * PI - turn) < 1e-9,
                "{heading_rad}: {}",
                back.heading_rad
            );
            assert!((0..3).all(|axis| (back.size_m[axis] - CAR.size_m[axis]).abs() < 1e-9));
            assert!((0..3).all(|axis| (back.center_m[axis] - CAR.center_m[axis]).abs() < 1e-9));
        }
    }

    #[test]
    fn implausible_boxes_are_removed() {
        let long = Box3d {
            size_m: [7.0, 2.0, 1.5],
            heading_rad: 0.0,
            ..CAR
        };
        let high = Box3d {
            center_m: [10.0, 2.0, 0.5],
            ..CAR
        };
        let flat = Box3d {
            size_m: [4.0, 2.0, 0.0],
            ..CAR
        };
        let far = Box3d {
            center_m: [10.0, 39.5, -1.0],
            ..CAR
        };
        for odd in [long, high, flat, far] {
            assert_eq!(run(&[decoded(odd, 0.9)]), [], "{odd:?}");
        }
        assert_eq!(run(&[decoded(CAR, 0.9)]).len(), 1);
    }

    #[test]
    fn two_agents_that_see_one_car_give_one_detection() {
        let ego_from_other = Isometry3::new(Vector3::new(5.0, -1.0, 0.0), Vector3::z() * 0.7);
        let seen_by_other = CAR.transformed(&ego_from_other.inverse());
        let (ego, other) = ([decoded(CAR, 0.6)], [decoded(seen_by_other, 0.8)]);
        let agents = [
            AgentBoxes {
                boxes: &ego,
                output_from_agent: Isometry3::identity(),
            },
            AgentBoxes {
                boxes: &other,
                output_from_agent: ego_from_other,
            },
        ];
        let found = postprocess(&agents, &PostprocessConfig::default());
        assert_eq!((found.len(), found[0].agent, found[0].score), (1, 1, 0.8));
        let back = corners_to_box(&found[0].corners);
        assert!((back.center_m[0] - 10.0).abs() < 1e-9 && (back.heading_rad - 0.3).abs() < 1e-9);
    }
}
