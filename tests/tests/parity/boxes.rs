//! Anchors, decoding, overlap, suppression and clean-up against the reference implementation.

use nalgebra::{Isometry3, Matrix4};
use perception::boxes::anchors::Anchors;
use perception::boxes::decode::{Decoded, decode, decode_box, sigmoid};
use perception::boxes::nms::rotated_nms;
use perception::boxes::postprocess::{
    self, AgentBoxes, Candidate, PostprocessConfig, corners_to_box,
};
use perception::model_config::{AnchorConfig, DetectorConfig};
use protocol::rotated_iou::Polygon;
use protocol::{Box3d, Pose};
use serde_json::Value;
use tests::fixtures::{Golden, assert_close, golden};

#[test]
fn golden_c3_anchors_full() {
    let golden = golden("c3_anchors_full");
    for (name, range, stride) in [
        ("opv2v_stride2", [-140.8, -40.0, -3.0, 140.8, 40.0, 1.0], 2),
        ("v2xvit_stride4", [-140.8, -38.4, -3.0, 140.8, 38.4, 1.0], 4),
    ] {
        if !golden.has(&format!("{name}.x")) {
            continue;
        }
        let voxel = [0.4, 0.4, 4.0];
        let anchors = anchors(range, voxel, stride, DetectorConfig::full().anchors);
        assert_close(
            name,
            &anchors.x_m,
            &golden.f64(&format!("{name}.x")).1,
            1e-9,
            0.0,
        );
        assert_close(
            name,
            &anchors.y_m,
            &golden.f64(&format!("{name}.y")).1,
            1e-9,
            0.0,
        );
        let (_, shape) = golden.i64(&format!("{name}.shape"));
        assert_eq!(
            shape,
            [
                anchors.y_m.len(),
                anchors.x_m.len(),
                anchors.yaws_rad.len(),
                7
            ]
            .map(|size| size as i64)
        );
        let (_, first) = golden.f64(&format!("{name}.first_cell"));
        for (anchor, expected) in first.as_chunks::<7>().0.iter().enumerate() {
            let found = hwl_of_box(&anchors.box_at(anchor));
            assert_close(name, &found, expected, 1e-9, 0.0);
        }
    }
}

#[test]
fn golden_c3_postprocess() {
    let golden = golden("c3_postprocess");
    let case = PostprocessCase::new(&golden);
    let agents = integer(&golden.config()["agents"]) as usize;
    let decoded: Vec<_> = (0..agents)
        .map(|agent| case.check_decoding(&golden, agent))
        .collect();
    let boxes: Vec<AgentBoxes<'_>> = (decoded.iter())
        .map(|(boxes, output_from_agent)| AgentBoxes {
            boxes,
            output_from_agent: *output_from_agent,
        })
        .collect();

    let candidates = case.check_filter(&golden, &boxes);
    case.check_suppression(&golden, &candidates);
    let found = postprocess::postprocess(&boxes, &case.config);
    assert_corners("out.final_corners", &golden, &found);
    let scores: Vec<f32> = found.iter().map(|candidate| candidate.score).collect();
    assert_close(
        "final scores",
        &scores,
        &golden.f32("out.final_scores").1,
        1e-6,
        0.0,
    );
}

#[test]
fn golden_c3_boxes_iou_nms() {
    let golden = golden("c3_boxes_iou_nms");
    let (_, boxes) = golden.f64("in.boxes_hwl");
    let boxes: Vec<Box3d> = boxes
        .as_chunks()
        .0
        .iter()
        .map(|&code| box_of_hwl(code))
        .collect();
    let corners: Vec<_> = boxes.iter().map(Box3d::corners).collect();
    let flat: Vec<f32> = corners
        .iter()
        .flatten()
        .flatten()
        .map(|&value| value as f32)
        .collect();
    assert_close("corners", &flat, &golden.f32("out.corners").1, 1e-4, 0.0);
    let polygons: Vec<_> = corners.iter().map(Polygon::footprint).collect();
    let iou: Vec<f32> = polygons
        .iter()
        .flat_map(|a| polygons.iter().map(|b| a.iou(b) as f32))
        .collect();
    assert_close("IoU", &iou, &golden.f32("out.iou").1, 1e-5, 0.0);
    check_picks(&golden, &polygons);
    check_corners_to_box(&golden, &boxes);
}

/// The picks at every stored threshold; their names have two digits of it.
fn check_picks(golden: &Golden, polygons: &[Polygon]) {
    let (_, scores) = golden.f32("in.scores");
    let thresholds = golden.config()["thresholds"]
        .as_array()
        .expect("thresholds")
        .clone();
    assert!(!thresholds.is_empty());
    for threshold in thresholds {
        let threshold = threshold.as_f64().expect("a number");
        let picks = rotated_nms(polygons, &scores, threshold, 1000);
        let (_, expected) = golden.i64(&format!("out.pick_{:02.0}", threshold * 100.0));
        assert_eq!(
            picks.iter().map(|&pick| pick as i64).collect::<Vec<_>>(),
            expected,
            "threshold {threshold}"
        );
    }
}

/// Corners to box, except for the yaw of boxes that point backwards, for which the reference's mean of angles fails.
fn check_corners_to_box(golden: &Golden, boxes: &[Box3d]) {
    let (_, stored_corners) = golden.f32("out.corners");
    let (_, expected) = golden.f32("out.corner_to_center_hwl");
    for (index, (expected, corners)) in expected
        .as_chunks::<7>()
        .0
        .iter()
        .zip(stored_corners.as_chunks::<24>().0)
        .enumerate()
    {
        let corners: [[f64; 3]; 8] =
            std::array::from_fn(|c| std::array::from_fn(|a| f64::from(corners[3 * c + a])));
        let actual = corners_to_box(&corners);
        let what = format!("box {index}");
        let [x, y, z, h, w, l, yaw] = expected.map(f64::from);
        assert_close(&what, &actual.center_m, &[x, y, z], 1e-4, 0.0);
        assert_close(&what, &actual.size_m, &[l, w, h], 1e-4, 0.0);
        assert!(
            angle_between(actual.heading_rad, boxes[index].heading_rad) < 1e-5,
            "{what}: heading"
        );
        let backwards = std::f64::consts::PI - boxes[index].heading_rad.abs() < 1e-5;
        assert!(
            backwards || angle_between(actual.heading_rad, yaw) < 1e-5,
            "{what}: heading of the reference"
        );
    }
}

/// Inputs of the chain of a case.
struct PostprocessCase {
    anchors: Anchors,
    config: PostprocessConfig,
}

impl PostprocessCase {
    fn new(golden: &Golden) -> Self {
        let config = golden.config();
        let number = |name: &str| {
            config[name]
                .as_f64()
                .unwrap_or_else(|| panic!("config {name}"))
        };
        let (range, voxel) = (array(&config["lidar_range"]), array(&config["voxel"]));
        let anchor_config = AnchorConfig {
            size_lwh_m: [number("l"), number("w"), number("h")],
            yaws_deg: config["r"]
                .as_array()
                .expect("yaws")
                .iter()
                .filter_map(Value::as_f64)
                .collect(),
            ..DetectorConfig::full().anchors
        };
        let anchors = anchors(range, voxel, integer(&config["stride"]), anchor_config);
        let (_, expected) = golden.f64("anchors");
        assert_eq!(expected.len(), anchors.len() * 7);
        for (index, expected) in expected.as_chunks::<7>().0.iter().enumerate() {
            let found = hwl_of_box(&anchors.box_at(index));
            assert_close("anchor", &found, expected, 1e-9, 0.0);
        }
        let keep: [f64; 6] = array(&config["gt_range"]);
        let config = PostprocessConfig {
            score_threshold: number("score_threshold") as f32,
            nms_iou: number("nms_thresh"),
            keep_range_m: [keep[0], keep[1], keep[3], keep[4]],
            ..PostprocessConfig::default()
        };
        Self { anchors, config }
    }

    /// Decodes one agent and compares every step up to its corners in the output frame.
    fn check_decoding(&self, golden: &Golden, agent: usize) -> (Vec<Decoded>, Isometry3<f64>) {
        let (_, scores) = golden.f32(&format!("in.{agent}.psm"));
        let (_, offsets) = golden.f32(&format!("in.{agent}.rm"));
        let (per_cell, cells) = (
            self.anchors.yaws_rad.len(),
            scores.len() / self.anchors.yaws_rad.len(),
        );
        let (_, all) = golden.f32(&format!("out.{agent}.decoded"));
        let (_, probabilities) = golden.f32(&format!("out.{agent}.prob"));
        for index in 0..self.anchors.len() {
            let (cell, anchor) = (index / per_cell, index % per_cell);
            let offsets =
                std::array::from_fn(|component| offsets[(7 * anchor + component) * cells + cell]);
            let anchor_box = self.anchors.box_at(index);
            let code = hwl_of_box(&decode_box(offsets, &anchor_box).expect("finite"));
            let expected: [f64; 7] =
                std::array::from_fn(|component| f64::from(all[index * 7 + component]));
            assert_close("decoded", &code, &expected, 1e-4, 0.0);
            assert!((sigmoid(scores[anchor * cells + cell]) - probabilities[index]).abs() < 1e-6);
        }
        let boxes = decode(
            &scores,
            &offsets,
            &self.anchors,
            self.config.score_threshold,
        )
        .unwrap();
        let mut selected = vec![0; self.anchors.len()];
        boxes
            .iter()
            .for_each(|decoded| selected[decoded.anchor] = 1);
        assert_eq!(
            selected,
            golden.u8(&format!("out.{agent}.selected")).1,
            "agent {agent}: selected"
        );

        let transform = golden.f32(&format!("in.{agent}.transform")).1;
        let matrix = Matrix4::from_row_iterator(transform.iter().map(|&value| f64::from(value)));
        let output_from_agent = Pose::from_matrix(&matrix)
            .expect("a rigid transform")
            .isometry();
        for (name, frame) in [
            ("corners", Isometry3::identity()),
            ("corners_projected", output_from_agent),
        ] {
            let actual: Vec<f32> = (boxes.iter())
                .flat_map(|decoded| {
                    project(&frame, &decoded.box3d)
                        .into_iter()
                        .flatten()
                        .map(|value| value as f32)
                })
                .collect();
            assert_close(
                name,
                &actual,
                &golden.f32(&format!("out.{agent}.{name}")).1,
                1e-4,
                0.0,
            );
        }
        (boxes, output_from_agent)
    }

    /// All candidates in the output frame, and those that the size and height filter keeps.
    fn check_filter(&self, golden: &Golden, agents: &[AgentBoxes<'_>]) -> Vec<Candidate> {
        let mut candidates: Vec<Candidate> = Vec::new();
        for (agent, boxes) in agents.iter().enumerate() {
            candidates.extend(boxes.boxes.iter().map(|decoded| Candidate {
                corners: project(&boxes.output_from_agent, &decoded.box3d),
                score: decoded.score,
                agent,
            }));
        }
        let is_kept =
            |candidate: &Candidate| postprocess::is_vehicle_sized(&candidate.corners, &self.config);
        let kept: Vec<u8> = candidates
            .iter()
            .map(|candidate| is_kept(candidate).into())
            .collect();
        assert_eq!(
            kept,
            golden.u8("out.kept_size_z").1,
            "size and height filter"
        );
        candidates.retain(is_kept);
        candidates
    }

    /// Input, overlaps with the best box, and picks of the suppression.
    fn check_suppression(&self, golden: &Golden, candidates: &[Candidate]) {
        assert_corners("out.nms_boxes", golden, candidates);
        let polygons: Vec<_> = candidates
            .iter()
            .map(|candidate| Polygon::footprint(&candidate.corners))
            .collect();
        let scores: Vec<f32> = candidates.iter().map(|candidate| candidate.score).collect();
        assert_close(
            "nms scores",
            &scores,
            &golden.f32("out.nms_scores").1,
            1e-6,
            0.0,
        );
        let best = (0..scores.len())
            .max_by(|&a, &b| scores[a].total_cmp(&scores[b]))
            .expect("candidates");
        let best_row: Vec<f32> = polygons
            .iter()
            .map(|other| polygons[best].iou(other) as f32)
            .collect();
        assert_close(
            "IoU of the best",
            &best_row,
            &golden.f32("out.nms_iou_first_row").1,
            1e-5,
            0.0,
        );
        let picks = rotated_nms(
            &polygons,
            &scores,
            self.config.nms_iou,
            self.config.nms_max_candidates,
        );
        assert_eq!(
            picks.iter().map(|&pick| pick as i64).collect::<Vec<_>>(),
            golden.i64("out.nms_pick").1,
            "picks"
        );
    }
}

fn project(frame: &Isometry3<f64>, box3d: &Box3d) -> [[f64; 3]; 8] {
    box3d
        .corners()
        .map(|corner| (frame * nalgebra::Point3::from(corner)).into())
}

fn assert_corners(name: &str, golden: &Golden, candidates: &[Candidate]) {
    let actual: Vec<f32> = candidates
        .iter()
        .flat_map(|candidate| candidate.corners)
        .flatten()
        .map(|value| value as f32)
        .collect();
    assert_close(name, &actual, &golden.f32(name).1, 1e-4, 0.0);
}

fn box_of_hwl([x, y, z, h, w, l, heading_rad]: [f64; 7]) -> Box3d {
    Box3d {
        center_m: [x, y, z],
        size_m: [l, w, h],
        heading_rad,
    }
}

fn hwl_of_box(box3d: &Box3d) -> [f64; 7] {
    let ([x, y, z], [l, w, h]) = (box3d.center_m, box3d.size_m);
    [x, y, z, h, w, l, box3d.heading_rad]
}

/// Smallest turn from one heading to another, radians.
fn angle_between(a: f64, b: f64) -> f64 {
    let turn = (a - b).rem_euclid(2.0 * std::f64::consts::PI);
    turn.min(2.0 * std::f64::consts::PI - turn)
}

fn integer(value: &Value) -> i64 {
    value
        .as_i64()
        .unwrap_or_else(|| panic!("{value} is not an integer"))
}

fn array<const N: usize>(value: &Value) -> [f64; N] {
    let values: Vec<f64> = value
        .as_array()
        .expect("a list")
        .iter()
        .filter_map(Value::as_f64)
        .collect();
    values
        .try_into()
        .unwrap_or_else(|_| panic!("{value} has not {N} numbers"))
}

/// The anchors of a head whose cells cover `stride` pillars along an axis.
fn anchors(range: [f64; 6], voxel: [f64; 3], stride: i64, anchors: AnchorConfig) -> Anchors {
    Anchors::for_detector(&DetectorConfig {
        lidar_range_m: range,
        voxel_size_m: voxel,
        layer_strides: vec![stride],
        upsample_strides: vec![1],
        shrink: None,
        anchors,
        ..DetectorConfig::full()
    })
}
