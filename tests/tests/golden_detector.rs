//! The detector against the reference implementation: encoder, voxelisation, anchors, decoding, suppression.

use std::collections::BTreeMap;

use agent::anchors::Anchors;
use agent::backbone::BevBackbone;
use agent::decode::{decode, decode_box, sigmoid};
use agent::head::DetectionHead;
use agent::model_config::{AnchorConfig, DetectorConfig, ShrinkConfig};
use agent::nms::rotated_nms;
use agent::pillar_batch::{PillarBatch, PillarLattice};
use agent::pillar_encoder::PillarEncoder;
use agent::pillars::{Pillars, Voxeliser};
use agent::postprocess::{self, AgentBoxes, Candidate, PostprocessConfig, corners_to_box, footprint};
use agent::shrink::{Compressor, Shrink};
use nalgebra::{Isometry3, Matrix4};
use protocol::{Box3d, Pose};
use serde_json::Value;
use tch::nn::VarStore;
use tch::{Device, Tensor};
use tests::fixtures::{Golden, assert_close, golden};

/// Tolerances of the encoder cases.
const ATOL: f64 = 2e-4;
const RTOL: f64 = 1e-4;

#[test]
fn golden_c1_pointpillar() {
    let Some(golden) = golden("c1_pointpillar") else { return };
    let case = EncoderCase::new(&golden);
    let (_, expected) = golden.f32("out.pillar_features");
    let pillar_features = tch::no_grad(|| case.encoder.forward(&case.batch, false));
    let rows = case.row_of_pillar.iter().map(|&row| row as i64).collect::<Vec<_>>();
    let in_file_order = pillar_features.index_select(0, &Tensor::from_slice(&rows));
    assert_close("pillar_features", &values(&in_file_order), &expected, ATOL, RTOL);

    let canvas = case.batch.scatter(&pillar_features, &case.lattice);
    let (_, expected) = golden.f32("out.spatial_features_ch0_7");
    assert_close("spatial_features", &values(&canvas.narrow(1, 0, 8)), &expected, ATOL, RTOL);

    for backbone in [None, Some(case.backbone.folded())] {
        let backbone = backbone.as_ref().unwrap_or(&case.backbone);
        case.check_from_2d(&golden, &tch::no_grad(|| backbone.forward(&canvas, false)));
    }
}

#[test]
fn golden_c1_intermediate_attfuse() {
    let Some(golden) = golden("c1_intermediate_attfuse") else { return };
    let case = EncoderCase::new(&golden);
    let (_, record_len) = golden.i64("in.record_len");
    let canvas = case.batch.scatter(&tch::no_grad(|| case.encoder.forward(&case.batch, false)), &case.lattice);
    for backbone in [None, Some(case.backbone.folded())] {
        let backbone = backbone.as_ref().unwrap_or(&case.backbone);
        let features = tch::no_grad(|| backbone.forward_fused(&canvas, &record_len, false)).unwrap();
        case.check_from_2d(&golden, &features);
    }
}

#[test]
fn golden_c1_shrink_compress() {
    let Some(golden) = golden("c1_shrink_compress") else { return };
    let config = golden.config();
    let (input, channels) = (integer(&config["input_dim"]), integer(&config["dim"][0]));
    let shrink_config = ShrinkConfig::DoubleConv { channels, stride: integer(&config["stride"][0]) };
    let network = VarStore::new(Device::Cpu);
    let shrink = Shrink::new(&(network.root() / "shrink"), input, &shrink_config);
    let compressor = Compressor::new(&(network.root() / "compress"), channels, integer(&config["compress_ratio"]));
    load(&network, &golden);
    let x = tensor(golden.f32("in.x"));
    for (shrink, compressor) in [(&shrink, &compressor), (&shrink.folded(), &compressor.folded())] {
        let (reduced, code, decoded) = tch::no_grad(|| {
            let reduced = shrink.forward(&x, false);
            let code = compressor.encode(&reduced, false);
            let decoded = compressor.decode(&code, false);
            (reduced, code, decoded)
        });
        for (name, actual) in [("out.shrink", reduced), ("out.code", code), ("out.decoded", decoded)] {
            let (shape, expected) = golden.f32(name);
            assert_eq!(actual.size(), shape.iter().map(|&size| size as i64).collect::<Vec<_>>(), "{name}");
            assert_close(name, &values(&actual), &expected, ATOL, RTOL);
        }
    }
}

#[test]
fn golden_c2_voxelise() {
    let Some(golden) = golden("c2_voxelise") else { return };
    let config = golden.config().as_object().expect("one configuration per cloud");
    assert!(!config.is_empty());
    for (name, config) in config {
        let grid: [usize; 3] = array(&config["grid"]).map(|count| count as usize);
        let caps = [&config["max_points_per_voxel"], &config["max_voxels"]].map(|cap| integer(cap) as usize);
        let mut voxeliser =
            Voxeliser::new(array(&config["lidar_range"]), array(&config["voxel_size"]), grid, caps[0], caps[1]);
        let (_, points) = golden.f32(&format!("{name}.in.points"));
        let points: Vec<[f32; 4]> = points.as_chunks().0.to_vec();
        let pillars = voxeliser.voxelise(&points);
        let (_, coords) = golden.i32(&format!("{name}.out.voxel_coords"));
        assert_eq!(pillars.coords.as_flattened(), coords, "{name}: coordinates");
        let (_, counts) = golden.i32(&format!("{name}.out.voxel_num_points"));
        assert!(pillars.counts.iter().zip(&counts).all(|(&a, &b)| i64::from(a) == i64::from(b)), "{name}: counts");
        let (_, features) = golden.f32(&format!("{name}.out.voxel_features_packed"));
        assert_eq!(pillars.points.as_flattened(), features, "{name}: points");
    }
}

#[test]
fn golden_c3_anchors_full() {
    let Some(golden) = golden("c3_anchors_full") else { return };
    for (name, range, stride) in [
        ("opv2v_stride2", [-140.8, -40.0, -3.0, 140.8, 40.0, 1.0], 2),
        ("v2xvit_stride4", [-140.8, -38.4, -3.0, 140.8, 38.4, 1.0], 4),
    ] {
        let voxel = [0.4, 0.4, 4.0];
        let anchors = Anchors::new(range, voxel, pillar_grid(range, voxel), stride, &AnchorConfig::default());
        assert_close(name, &anchors.x_m, &golden.f64(&format!("{name}.x")).1, 1e-9, 0.0);
        assert_close(name, &anchors.y_m, &golden.f64(&format!("{name}.y")).1, 1e-9, 0.0);
        let (_, shape) = golden.i64(&format!("{name}.shape"));
        assert_eq!(shape, [anchors.y_m.len(), anchors.x_m.len(), anchors.yaws_rad.len(), 7].map(|size| size as i64));
        let (_, first) = golden.f64(&format!("{name}.first_cell"));
        for (anchor, expected) in first.as_chunks::<7>().0.iter().enumerate() {
            assert_close(name, &anchors.get(anchor), expected, 1e-9, 0.0);
        }
    }
}

#[test]
fn golden_c3_postprocess() {
    let Some(golden) = golden("c3_postprocess") else { return };
    let case = PostprocessCase::new(&golden);
    let agents = integer(&golden.config()["agents"]) as usize;
    let decoded: Vec<_> = (0..agents).map(|agent| case.check_decoding(&golden, agent)).collect();
    let boxes: Vec<AgentBoxes<'_>> = (decoded.iter())
        .map(|(boxes, output_from_agent)| AgentBoxes { boxes, output_from_agent: *output_from_agent })
        .collect();

    let projected: Vec<Candidate> = (boxes.iter().enumerate())
        .flat_map(|(agent, boxes)| {
            boxes.boxes.iter().map(move |decoded| Candidate {
                corners: project(&boxes.output_from_agent, &decoded.box3d),
                score: decoded.score,
                agent,
            })
        })
        .collect();
    let (_, kept_mask) = golden.u8("out.kept_size_z");
    let kept: Vec<u8> = (projected.iter())
        .map(|candidate| postprocess::is_vehicle_sized(&candidate.corners, &case.config).into())
        .collect();
    assert_eq!(kept, kept_mask, "size and height filter");

    let candidates: Vec<Candidate> =
        projected.into_iter().zip(&kept).filter(|(_, kept)| **kept == 1).map(|(candidate, _)| candidate).collect();
    assert_corners("out.nms_boxes", &golden, &candidates);
    let polygons: Vec<_> = candidates.iter().map(|candidate| footprint(&candidate.corners)).collect();
    let scores: Vec<f32> = candidates.iter().map(|candidate| candidate.score).collect();
    assert_close("nms scores", &scores, &golden.f32("out.nms_scores").1, 1e-6, 0.0);
    let best = (0..scores.len()).max_by(|&a, &b| scores[a].total_cmp(&scores[b])).expect("candidates");
    let best_row: Vec<f32> = polygons.iter().map(|other| polygons[best].iou(other) as f32).collect();
    assert_close("IoU of the best", &best_row, &golden.f32("out.nms_iou_first_row").1, 1e-5, 0.0);
    let picks = rotated_nms(&polygons, &scores, case.config.nms_iou, case.config.nms_max_candidates);
    assert_eq!(picks.iter().map(|&pick| pick as i64).collect::<Vec<_>>(), golden.i64("out.nms_pick").1, "picks");

    let found = postprocess::postprocess(&boxes, &case.config);
    assert_corners("out.final_corners", &golden, &found);
    let scores: Vec<f32> = found.iter().map(|candidate| candidate.score).collect();
    assert_close("final scores", &scores, &golden.f32("out.final_scores").1, 1e-6, 0.0);
}

#[test]
fn golden_c3_boxes_iou_nms() {
    let Some(golden) = golden("c3_boxes_iou_nms") else { return };
    let (_, boxes) = golden.f64("in.boxes_hwl");
    let boxes: Vec<Box3d> = boxes.as_chunks().0.iter().map(|&code| box_of_hwl(code)).collect();
    let corners: Vec<_> = boxes.iter().map(Box3d::corners).collect();
    let flat: Vec<f32> = corners.iter().flatten().flatten().map(|&value| value as f32).collect();
    assert_close("corners", &flat, &golden.f32("out.corners").1, 1e-4, 0.0);
    let polygons: Vec<_> = corners.iter().map(footprint).collect();
    let iou: Vec<f32> = polygons.iter().flat_map(|a| polygons.iter().map(|b| a.iou(b) as f32)).collect();
    assert_close("IoU", &iou, &golden.f32("out.iou").1, 1e-5, 0.0);
    check_picks(&golden, &polygons);
    check_corners_to_box(&golden, &boxes);
}

/// The picks at every stored threshold; their names hold two digits of it.
fn check_picks(golden: &Golden, polygons: &[agent::rotated_iou::Polygon]) {
    let (_, scores) = golden.f32("in.scores");
    let thresholds = golden.config()["thresholds"].as_array().expect("thresholds").clone();
    assert!(!thresholds.is_empty());
    for threshold in thresholds {
        let threshold = threshold.as_f64().expect("a number");
        let picks = rotated_nms(polygons, &scores, threshold, 1000);
        let (_, expected) = golden.i64(&format!("out.pick_{:02.0}", threshold * 100.0));
        assert_eq!(picks.iter().map(|&pick| pick as i64).collect::<Vec<_>>(), expected, "threshold {threshold}");
    }
}

/// Corners to box, apart from the yaw of boxes that point backwards, where the reference's mean of angles breaks.
fn check_corners_to_box(golden: &Golden, boxes: &[Box3d]) {
    let (_, stored_corners) = golden.f32("out.corners");
    let (_, expected) = golden.f32("out.corner_to_center_hwl");
    for (index, (expected, corners)) in
        expected.as_chunks::<7>().0.iter().zip(stored_corners.as_chunks::<24>().0).enumerate()
    {
        let corners: [[f64; 3]; 8] = std::array::from_fn(|c| std::array::from_fn(|a| f64::from(corners[3 * c + a])));
        let actual = corners_to_box(&corners);
        let what = format!("box {index}");
        let [x, y, z, h, w, l, yaw] = expected.map(f64::from);
        assert_close(&what, &actual.center_m, &[x, y, z], 1e-4, 0.0);
        assert_close(&what, &actual.size_m, &[l, w, h], 1e-4, 0.0);
        assert!(angle_between(actual.heading_rad, boxes[index].heading_rad) < 1e-5, "{what}: heading");
        let backwards = std::f64::consts::PI - boxes[index].heading_rad.abs() < 1e-5;
        assert!(backwards || angle_between(actual.heading_rad, yaw) < 1e-5, "{what}: heading of the reference");
    }
}

/// A whole encoder with the weights of a case, and its input.
struct EncoderCase {
    lattice: PillarLattice,
    batch: PillarBatch,
    /// Row of the batch for every pillar in the order of the file.
    row_of_pillar: Vec<usize>,
    encoder: PillarEncoder,
    backbone: BevBackbone,
    head: DetectionHead,
}

impl EncoderCase {
    fn new(golden: &Golden) -> Self {
        tch::set_num_threads(1);
        let config = encoder_config(golden);
        let network = VarStore::new(Device::Cpu);
        let root = network.root();
        let encoder = PillarEncoder::new(&(&root / "pillar_vfe"), config.pillar_channels);
        let backbone = BevBackbone::new(&(&root / "backbone"), &config);
        let anchors = golden.f32("w.cls_head.bias").1.len() as i64;
        let head = DetectionHead::new(&root, config.backbone_channels(), anchors);
        load(&network, golden);
        let lattice = PillarLattice::new(&config);
        let (sweeps, row_of_pillar) = pillars(golden);
        let batch = PillarBatch::new(&sweeps.iter().collect::<Vec<_>>(), &lattice);
        Self { lattice, batch, row_of_pillar, encoder, backbone, head }
    }

    /// Compares the concatenated levels and the heads.
    fn check_from_2d(&self, golden: &Golden, features: &Tensor) {
        let every_8th: Vec<i64> = (0..features.size()[1]).step_by(8).collect();
        let (_, expected) = golden.f32("out.spatial_features_2d_ch_every_8th");
        let part = features.index_select(1, &Tensor::from_slice(&every_8th));
        assert_close("spatial_features_2d", &values(&part), &expected, ATOL, RTOL);
        let heads = tch::no_grad(|| self.head.forward(features)).unwrap();
        assert_close("psm", &values(&heads.scores), &golden.f32("out.psm").1, ATOL, RTOL);
        assert_close("rm", &values(&heads.offsets), &golden.f32("out.rm").1, ATOL, RTOL);
    }
}

/// The sizes of the network, from the configuration and the shapes of the weights.
fn encoder_config(golden: &Golden) -> DetectorConfig {
    let config = golden.config();
    let layer_nums: Vec<usize> = list(&config["layer_nums"]).iter().map(|&count| count as usize).collect();
    let levels = layer_nums.len();
    let deblock = |level: usize| golden.f32(&format!("w.backbone.deblocks.{level}.0.weight")).0;
    DetectorConfig {
        name: "golden".into(),
        lidar_range_m: array(&config["lidar_range"]),
        voxel_size_m: array(&config["voxel_size"]),
        max_points_per_pillar: integer(&config["max_points"]) as usize,
        pillar_channels: golden.f32("w.pillar_vfe.pfn_layers.0.linear.weight").0[0] as i64,
        layer_nums,
        layer_strides: vec![2; levels],
        num_filters: list(&config["num_filters"]),
        upsample_strides: (0..levels).map(|level| deblock(level)[2] as i64).collect(),
        num_upsample_filters: (0..levels).map(|level| deblock(level)[1] as i64).collect(),
        shrink: None,
        ..DetectorConfig::full()
    }
}

/// The pillars of each sweep of an encoder case, and where each pillar of the file went.
fn pillars(golden: &Golden) -> (Vec<Pillars>, Vec<usize>) {
    let (shape, features) = golden.f32("in.voxel_features");
    let (_, coords) = golden.i32("in.voxel_coords");
    let (_, counts) = golden.i32("in.voxel_num_points");
    let coords = coords.as_chunks::<4>().0;
    let sweeps = coords.iter().map(|coord| coord[0]).max().map_or(0, |last| last as usize + 1);
    let mut pillars = vec![Pillars::default(); sweeps];
    for (index, &[sweep, z, y, x]) in coords.iter().enumerate() {
        let pillar = &mut pillars[sweep as usize];
        let points = features[index * shape[1] * 4..].as_chunks::<4>().0;
        pillar.points.extend(&points[..counts[index] as usize]);
        pillar.counts.push(counts[index] as u32);
        pillar.coords.push([z, y, x]);
    }
    let firsts: Vec<usize> = (0..sweeps).map(|sweep| pillars[..sweep].iter().map(Pillars::len).sum()).collect();
    let mut next = firsts;
    let rows = coords.iter().map(|coord| {
        let row = &mut next[coord[0] as usize];
        *row += 1;
        *row - 1
    });
    let rows = rows.collect();
    (pillars, rows)
}

/// What the chain of a case needs.
struct PostprocessCase {
    anchors: Anchors,
    config: PostprocessConfig,
}

impl PostprocessCase {
    fn new(golden: &Golden) -> Self {
        let config = golden.config();
        let number = |name: &str| config[name].as_f64().unwrap_or_else(|| panic!("config {name}"));
        let (range, voxel) = (array(&config["lidar_range"]), array(&config["voxel"]));
        let anchor_config = AnchorConfig {
            size_lwh_m: [number("l"), number("w"), number("h")],
            yaws_deg: config["r"].as_array().expect("yaws").iter().filter_map(Value::as_f64).collect(),
            ..AnchorConfig::default()
        };
        let stride = integer(&config["stride"]) as usize;
        let anchors = Anchors::new(range, voxel, pillar_grid(range, voxel), stride, &anchor_config);
        let (_, expected) = golden.f64("anchors");
        assert_eq!(expected.len(), anchors.len() * 7);
        for (index, expected) in expected.as_chunks::<7>().0.iter().enumerate() {
            assert_close("anchor", &anchors.get(index), expected, 1e-9, 0.0);
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
    fn check_decoding(&self, golden: &Golden, agent: usize) -> (Vec<agent::decode::Decoded>, Isometry3<f64>) {
        let (_, scores) = golden.f32(&format!("in.{agent}.psm"));
        let (_, offsets) = golden.f32(&format!("in.{agent}.rm"));
        let (per_cell, cells) = (self.anchors.yaws_rad.len(), scores.len() / self.anchors.yaws_rad.len());
        let (_, all) = golden.f32(&format!("out.{agent}.decoded"));
        let (_, probabilities) = golden.f32(&format!("out.{agent}.prob"));
        for index in 0..self.anchors.len() {
            let (cell, anchor) = (index / per_cell, index % per_cell);
            let offsets = std::array::from_fn(|component| offsets[(7 * anchor + component) * cells + cell]);
            let code = hwl_of_box(&decode_box(offsets, self.anchors.get(index)).expect("finite"));
            let expected: [f64; 7] = std::array::from_fn(|component| f64::from(all[index * 7 + component]));
            assert_close("decoded", &code, &expected, 1e-4, 0.0);
            assert!((sigmoid(scores[anchor * cells + cell]) - probabilities[index]).abs() < 1e-6);
        }
        let boxes = decode(&scores, &offsets, &self.anchors, self.config.score_threshold).unwrap();
        let mut selected = vec![0; self.anchors.len()];
        boxes.iter().for_each(|decoded| selected[decoded.anchor] = 1);
        assert_eq!(selected, golden.u8(&format!("out.{agent}.selected")).1, "agent {agent}: selected");

        let transform = golden.f32(&format!("in.{agent}.transform")).1;
        let matrix = Matrix4::from_row_iterator(transform.iter().map(|&value| f64::from(value)));
        let output_from_agent = Pose::from_matrix(&matrix).expect("a rigid transform").isometry();
        for (name, frame) in [("corners", Isometry3::identity()), ("corners_projected", output_from_agent)] {
            let actual: Vec<f32> = (boxes.iter())
                .flat_map(|decoded| project(&frame, &decoded.box3d).into_iter().flatten().map(|value| value as f32))
                .collect();
            assert_close(name, &actual, &golden.f32(&format!("out.{agent}.{name}")).1, 1e-4, 0.0);
        }
        (boxes, output_from_agent)
    }
}

fn project(frame: &Isometry3<f64>, box3d: &Box3d) -> [[f64; 3]; 8] {
    box3d.corners().map(|corner| (frame * nalgebra::Point3::from(corner)).into())
}

fn assert_corners(name: &str, golden: &Golden, candidates: &[Candidate]) {
    let actual: Vec<f32> =
        candidates.iter().flat_map(|candidate| candidate.corners).flatten().map(|value| value as f32).collect();
    assert_close(name, &actual, &golden.f32(name).1, 1e-4, 0.0);
}

fn box_of_hwl([x, y, z, h, w, l, heading_rad]: [f64; 7]) -> Box3d {
    Box3d { center_m: [x, y, z], size_m: [l, w, h], heading_rad }
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

/// Copies the `w.*` tensors of a case into the network; each parameter must be there.
fn load(network: &VarStore, golden: &Golden) {
    let variables: BTreeMap<String, Tensor> = network.variables().into_iter().collect();
    assert!(!variables.is_empty());
    for (name, mut variable) in variables {
        let source = tensor(golden.f32(&format!("w.{name}")));
        assert_eq!(source.size(), variable.size(), "{name}");
        tch::no_grad(|| variable.copy_(&source));
    }
}

fn tensor((shape, values): (Vec<usize>, Vec<f32>)) -> Tensor {
    Tensor::from_slice(&values).reshape(shape.iter().map(|&size| size as i64).collect::<Vec<_>>())
}

fn values(tensor: &Tensor) -> Vec<f32> {
    Vec::try_from(&tensor.contiguous().view([-1])).expect("f32 values")
}

fn integer(value: &Value) -> i64 {
    value.as_i64().unwrap_or_else(|| panic!("{value} is not an integer"))
}

fn list(value: &Value) -> Vec<i64> {
    value.as_array().expect("a list").iter().map(integer).collect()
}

fn array<const N: usize>(value: &Value) -> [f64; N] {
    let values: Vec<f64> = value.as_array().expect("a list").iter().filter_map(Value::as_f64).collect();
    values.try_into().unwrap_or_else(|_| panic!("{value} has not {N} numbers"))
}

fn pillar_grid(range: [f64; 6], voxel: [f64; 3]) -> [usize; 3] {
    std::array::from_fn(|axis| ((range[axis + 3] - range[axis]) / voxel[axis]).round() as usize)
}
