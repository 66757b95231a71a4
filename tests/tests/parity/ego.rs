//! Training targets, loss, AP, warps and fusion against the reference implementations.

use ::training::loss::{self, LabelTensors, Unassigned, detection_loss};
use dataset::average_precision::{Ordering, PrecisionRecallCurve, Scorer};
use dataset::ground_truth::GroundTruth;
use fusion::targets::{BOX_CODE, Labels, NEGATIVE_IOU, POSITIVE_IOU, Positive, TargetAssigner};
use fusion::warp::{coalign, warp_to_ego};
use fusion::{AlignedMaps, AttentionFusion, Fusion, MapMetadata, MaxFusion};
use perception::boxes::anchors::Anchors;
use protocol::{BevGrid, Box3d, Detection, Pose};
use tch::{Device, Kind, Tensor};
use tests::fixtures::{Golden, assert_close, golden};
use tests::opencood::{self, Interpolation, regroup};

#[test]
fn golden_c3_targets() {
    let golden = golden("c3_targets");
    let config = golden.config();
    let (shape, anchors) = golden.f64("anchors");
    let (_, objects) = golden.f64("in.gt");
    let (_, mask) = golden.f64("in.mask");
    let threshold = |name: &str| config[name].as_f64().unwrap() as f32;
    let thresholds = ["pos_threshold", "neg_threshold"].map(threshold);
    assert_eq!(thresholds, [POSITIVE_IOU, NEGATIVE_IOU]);
    assert_eq!(config["order"], "hwl");
    let boxes: Vec<Box3d> = anchors.as_chunks().0.iter().map(box_of_hwl).collect();
    let (width, per_cell) = (shape[1], shape[2]);
    let anchors = Anchors {
        x_m: (0..width)
            .map(|column| boxes[column * per_cell].center_m[0])
            .collect(),
        y_m: (0..shape[0])
            .map(|row| boxes[row * width * per_cell].center_m[1])
            .collect(),
        z_m: boxes[0].center_m[2],
        size_lwh_m: boxes[0].size_m,
        yaws_rad: boxes[..per_cell].iter().map(|it| it.heading_rad).collect(),
    };
    assert!((0..boxes.len()).all(|index| anchors.box_at(index) == boxes[index]));
    let assigner = TargetAssigner::new(anchors);
    let objects: Vec<Box3d> = objects
        .as_chunks()
        .0
        .iter()
        .zip(&mask)
        .filter(|(_, mask)| **mask == 1.0)
        .map(|(row, _)| box_of_hwl(row))
        .collect();
    let labels = assigner.assign(&objects);

    let (_, positive) = golden.f64("out.pos_equal_one");
    let (_, negative) = golden.f64("out.neg_equal_one");
    let (_, targets) = golden.f64("out.targets");
    let found: Vec<usize> = labels
        .positives
        .iter()
        .map(|positive| positive.anchor)
        .collect();
    let expected: Vec<usize> = (0..positive.len())
        .filter(|&index| positive[index] == 1.0)
        .collect();
    assert_eq!(found, expected, "positive anchors");
    assert!(
        !expected.is_empty(),
        "a case without positives tests nothing"
    );
    let unassigned: Vec<usize> = (0..positive.len())
        .filter(|&index| positive[index] == 0.0 && negative[index] == 0.0)
        .collect();
    assert_eq!(
        labels.unassigned, unassigned,
        "anchors of the band between the thresholds"
    );
    let mut dense = vec![0.0; targets.len()];
    for positive in &labels.positives {
        dense[positive.anchor * BOX_CODE..(positive.anchor + 1) * BOX_CODE]
            .copy_from_slice(&positive.code);
    }
    assert_close("targets", &dense, &targets, 1e-10, 1e-10);
}

#[test]
fn golden_c4_average_precision() {
    let golden = golden("c4_ap");
    let config = golden.config();
    let thresholds: Vec<f64> = config["thresholds"]
        .as_array()
        .unwrap()
        .iter()
        .map(|t| t.as_f64().unwrap())
        .collect();
    let mut scorer = Scorer::new(&thresholds);
    for frame in 0..config["frames"].as_u64().unwrap() {
        let boxes = |name: &str| {
            let (_, corners) = golden.f32(&format!("in.{frame:02}.{name}"));
            corners
                .as_chunks::<24>()
                .0
                .iter()
                .map(box_of_corners)
                .collect::<Vec<_>>()
        };
        let (_, scores) = golden.f32(&format!("in.{frame:02}.det_scores"));
        let found: Vec<Detection> = boxes("det_corners")
            .into_iter()
            .zip(scores)
            .map(|(box3d, score)| Detection {
                box3d,
                score,
                source: None,
            })
            .collect();
        scorer.add(&found, &GroundTruth::of_boxes(boxes("gt_corners")));
    }
    for (tally, threshold) in scorer.tallies.iter().zip(&thresholds) {
        let prefix = format!("out.{:02.0}", threshold * 100.0);
        let lists = |pick: fn(bool) -> bool| -> Vec<i64> {
            tally
                .matched
                .iter()
                .map(|entry| i64::from(pick(entry.is_true)))
                .collect()
        };
        assert_eq!(
            lists(|is_true| is_true),
            golden.i64(&format!("{prefix}.tp")).1,
            "{prefix}.tp"
        );
        assert_eq!(
            lists(|is_true| !is_true),
            golden.i64(&format!("{prefix}.fp")).1,
            "{prefix}.fp"
        );
        let scores: Vec<f32> = tally.matched.iter().map(|entry| entry.score).collect();
        assert_eq!(
            scores,
            golden.f32(&format!("{prefix}.score")).1,
            "{prefix}.score"
        );
        assert_eq!(
            tally.objects as i64,
            golden.i64(&format!("{prefix}.gt")).1[0],
            "{prefix}.gt"
        );
        for (ordering, name) in [
            (Ordering::Frame, "frame_order"),
            (Ordering::Global, "global"),
        ] {
            let PrecisionRecallCurve {
                average_precision,
                recall,
                precision,
            } = tally.curve(ordering);
            let stored = |what: &str| golden.f64(&format!("{prefix}.{name}.{what}")).1;
            assert_close(
                &format!("{prefix}.{name}.ap"),
                &[average_precision.unwrap()],
                &stored("ap"),
                1e-9,
                0.0,
            );
            assert_close(
                &format!("{prefix}.{name}.mrec"),
                &recall,
                &stored("mrec"),
                1e-9,
                0.0,
            );
            assert_close(
                &format!("{prefix}.{name}.mpre"),
                &precision,
                &stored("mpre"),
                1e-9,
                0.0,
            );
        }
    }
}

#[test]
fn golden_c5_warp_opencood() {
    let golden = golden("c5_warp_opencood");
    let [height, width] = ["H", "W"].map(|name| golden.config()[name].as_i64().unwrap());
    let pixel_m = number(&golden, "discrete_ratio") * number(&golden, "downsample_rate");
    let features = tensor(&golden, "in.x");
    let transforms = tensor(&golden, "in.matrix4");
    let present = tensor(&golden, "in.cav_mask");
    let close = |name: &str, found: &Tensor, atol: f64| {
        assert_eq!(
            found.size(),
            tensor(&golden, name).size(),
            "shape of {name}"
        );
        assert_close(name, &values(found), &golden.f32(name).1, atol, 0.0);
    };

    let pixels = opencood::discretized(&transforms, pixel_m).unwrap();
    close("out.discretized", &pixels, 1e-5);
    let flat = pixels.view([-1, 2, 3]);
    let centred = opencood::about_centre(&flat, height, width).unwrap();
    close("out.centre_matrix", &centred, 1e-4);
    let warp = |matrix: &Tensor, mode| opencood::warp_affine(&features, matrix, mode).unwrap();
    close(
        "out.warp_affine",
        &warp(&centred, Interpolation::Bilinear),
        1e-4,
    );
    close(
        "out.warp_affine_nearest",
        &warp(&centred, Interpolation::Nearest),
        0.0,
    );
    close(
        "out.warp_affine_no_centre",
        &warp(&flat, Interpolation::Bilinear),
        1e-4,
    );

    let mask = opencood::roi_mask(&transforms, &present, height, width, pixel_m).unwrap();
    close(
        "out.roi_and_cav_mask",
        &mask.permute([0, 2, 3, 1]).unsqueeze(3),
        0.0,
    );
    let no_centre = opencood::rotated_extent(&flat, height, width).unwrap();
    let (batch, agents) = present.size2().unwrap();
    close(
        "out.roi_no_centre",
        &no_centre.view([batch, agents, 1, height, width]),
        0.0,
    );

    let channels_last = features
        .view([batch, agents, -1, height, width])
        .permute([0, 1, 3, 4, 2]);
    close(
        "out.sttf",
        &opencood::spatial_correction(&channels_last, &transforms, pixel_m).unwrap(),
        1e-4,
    );
}

#[test]
fn golden_c5_warp_coalign() {
    let golden = golden("c5_warp_coalign");
    let size = |name: &str| golden.config()[name].as_i64().unwrap();
    let ratio = number(&golden, "discrete_ratio");
    let pairwise = tensor(&golden, "in.pairwise");
    let downsampled = coalign::normalized(
        &pairwise,
        size("H"),
        size("W"),
        ratio * number(&golden, "downsample_rate"),
    )
    .unwrap();
    assert_close(
        "downsampled",
        &values(&downsampled),
        &golden.f32("out.normalized_downsampled").1,
        1e-4,
        1e-5,
    );
    let full = coalign::normalized(&pairwise, size("H0"), size("W0"), ratio).unwrap();
    assert_close(
        "full resolution",
        &values(&full),
        &golden.f32("out.normalized_full_res").1,
        1e-4,
        1e-5,
    );

    let features = tensor(&golden, "in.x");
    let expected = tensor(&golden, "out.warp_affine_simple");
    let [samples, agents] = [features.size()[0], features.size()[1]];
    for sample in 0..samples {
        for ego in 0..agents {
            let warped =
                coalign::warp_affine(&features.get(sample), &downsampled.get(sample).get(ego))
                    .unwrap();
            let expected = expected.get(sample).get(ego);
            assert_close(
                &format!("warp {sample} {ego}"),
                &values(&warped),
                &values(&expected),
                1e-4,
                0.0,
            );
        }
    }
}

/// The project's own warp, exact in metres, against CoAlign's on a BEV grid around the vehicle, where both are equal.
#[test]
fn golden_c5_warp_in_metres_agrees_with_coalign() {
    let golden = golden("c5_warp_coalign");
    let size = |name: &str| golden.config()[name].as_u64().unwrap() as u32;
    let cell_m = number(&golden, "discrete_ratio") * number(&golden, "downsample_rate");
    let (width, height) = (size("W"), size("H"));
    let grid = BevGrid {
        x_min_m: -cell_m * f64::from(width) / 2.0,
        y_min_m: -cell_m * f64::from(height) / 2.0,
        cell_m,
        width,
        height,
    };
    let features = tensor(&golden, "in.x");
    let pairwise = tensor(&golden, "in.pairwise");
    let expected = tensor(&golden, "out.warp_affine_simple");
    for sample in 0..features.size()[0] {
        for ego in 0..features.size()[1] {
            // P[ego, cav] transforms points of the ego to the frame of the CAV; only its planar part enters a warp.
            let poses: Vec<Pose> = (0..features.size()[1])
                .map(|cav| planar_inverse(&pairwise.get(sample).get(ego).get(cav)))
                .collect();
            let warped = warp_to_ego(&features.get(sample), None, &poses, &grid).unwrap();
            let expected = expected.get(sample).get(ego) * &warped.mask;
            // The reference scales sheared planar parts of tilted poses; this project's warp keeps them rigid.
            let difference = (&warped.features - expected)
                .abs()
                .mean(Kind::Float)
                .double_value(&[]);
            assert!(
                difference < 2e-2,
                "sample {sample}, ego {ego}: {difference}"
            );
        }
    }
}

#[test]
fn golden_c5_pairwise_coalign() {
    let golden = golden("c5_pairwise_coalign");
    let pairwise = tensor(&golden, "out.pairwise_torch6");
    let mut cases = 0;
    for name in golden.names() {
        let Some(case) = name.strip_prefix("out.normalized_") else {
            continue;
        };
        // The name has the parameters: <rows>x<columns>_r<voxel size>_d<down-sampling>.
        let mut parts = case.split('_');
        let (rows, columns) = parts.next().unwrap().split_once('x').unwrap();
        let ratio: f64 = parts
            .next()
            .unwrap()
            .strip_prefix('r')
            .unwrap()
            .parse()
            .unwrap();
        let down: f64 = parts
            .next()
            .unwrap()
            .strip_prefix('d')
            .unwrap()
            .parse()
            .unwrap();
        let (height, width) = (rows.parse().unwrap(), columns.parse().unwrap());
        let found = coalign::normalized(&pairwise, height, width, ratio * down).unwrap();
        assert_close(&name, &values(&found), &golden.f32(&name).1, 1e-4, 1e-5);
        cases += 1;
    }
    assert!(cases > 0, "no normalised matrices in the archive");
}

#[test]
fn golden_c6_att_max() {
    let golden = golden("c6_att_max");
    let features = tensor(&golden, "in.x");
    let (_, agents) = golden.i64("in.record_len");
    check_fusion(&golden, "out.att", &AttentionFusion, &features, &agents);
    check_fusion(&golden, "out.max", &MaxFusion, &features, &agents);
    let (groups, mask) = regroup(
        &features,
        &agents,
        golden.config()["max_cav"].as_i64().unwrap(),
    )
    .unwrap();
    assert_eq!(groups, tensor(&golden, "out.regroup"));
    assert_eq!(
        Vec::<i64>::try_from(mask.to_kind(Kind::Int64).view(-1)).unwrap(),
        golden.i64("out.regroup_mask").1
    );
}

#[test]
fn golden_c6_coalign_att_max() {
    let golden = golden("c6_coalign_att_max");
    let features = tensor(&golden, "in.x");
    let normalized = tensor(&golden, "in.normalized");
    let (_, agents) = golden.i64("in.record_len");
    // The reference's two inputs, raw pairwise transforms and normalised ones, lead to the same result.
    let full_size = golden.config()["full_size"][0].as_f64().unwrap();
    let [.., height, width] = features.size()[..] else {
        panic!("features have four dimensions")
    };
    let pixel_m = number(&golden, "discrete_ratio") * full_size / height as f64;
    let from_raw =
        coalign::normalized(&tensor(&golden, "in.pairwise"), height, width, pixel_m).unwrap();
    assert_close(
        "normalized",
        &values(&from_raw),
        &values(&normalized),
        1e-4,
        1e-5,
    );
    let mut warped = Vec::new();
    for (sample, views) in features
        .split_with_sizes(agents.as_slice(), 0)
        .into_iter()
        .enumerate()
    {
        let matrices = normalized
            .get(sample as i64)
            .get(0)
            .narrow(0, 0, views.size()[0]);
        warped.push(coalign::warp_affine(&views, &matrices).unwrap());
    }
    let warped = Tensor::cat(&warped, 0);
    assert_close(
        "warped",
        &values(&warped),
        &golden.f32("out.warped_to_ego").1,
        1e-4,
        0.0,
    );
    check_fusion(&golden, "out.att", &AttentionFusion, &warped, &agents);
    check_fusion(&golden, "out.att_raw", &AttentionFusion, &warped, &agents);
    check_fusion(&golden, "out.max", &MaxFusion, &warped, &agents);
}

#[test]
fn golden_c7_loss() {
    let golden = golden("c7_loss");
    let scores = tensor(&golden, "in.psm").set_requires_grad(true);
    let boxes = tensor(&golden, "in.rm").set_requires_grad(true);
    let (shape, positive) = golden.f32("in.pos_equal_one");
    let (_, targets) = golden.f32("in.targets");
    let anchors = shape[1..].iter().product();
    let labels: Vec<Labels> = positive
        .chunks(anchors)
        .zip(targets.chunks(anchors * BOX_CODE))
        .map(|(positive, targets)| labels_of_dense(positive, targets))
        .collect();
    let constants =
        ["alpha", "gamma", "beta", "cls_weight", "reg"].map(|name| number(&golden, name));
    assert_eq!(
        constants,
        [
            loss::ALPHA,
            loss::GAMMA,
            loss::BETA,
            loss::SCORE_WEIGHT,
            loss::BOX_WEIGHT
        ]
    );
    let labels = LabelTensors::gather(&labels, Unassigned::Background, Device::Cpu);
    let loss = detection_loss(&scores, &boxes, &labels).unwrap();
    assert_close(
        "conf",
        &values(&loss.score),
        &golden.f32("out.conf").1,
        0.0,
        1e-5,
    );
    assert_close(
        "reg",
        &values(&loss.boxes),
        &golden.f32("out.reg").1,
        0.0,
        1e-5,
    );
    assert_close(
        "total",
        &values(&loss.total()),
        &golden.f32("out.total").1,
        0.0,
        1e-5,
    );
    loss.total().backward();
    assert_close(
        "grad_psm",
        &values(&scores.grad()),
        &golden.f32("out.grad_psm").1,
        1e-6,
        1e-4,
    );
    assert_close(
        "grad_rm",
        &values(&boxes.grad()),
        &golden.f32("out.grad_rm").1,
        1e-6,
        1e-4,
    );
}

fn check_fusion(
    golden: &Golden,
    name: &str,
    fusion: &dyn Fusion,
    features: &Tensor,
    agents: &[i64],
) {
    let fused: Vec<Tensor> = features
        .split_with_sizes(agents, 0)
        .iter()
        .map(|features| {
            let [views, _, height, width] = features.size()[..] else {
                panic!("features have four dimensions")
            };
            let mask = Tensor::ones([views, 1, height, width], (Kind::Float, Device::Cpu));
            let facts: Vec<_> = (0..views as usize)
                .map(|agent| MapMetadata::fresh(agent, Pose::IDENTITY))
                .collect();
            let [width, height] = [width, height].map(|size| size as u32);
            let grid = BevGrid {
                x_min_m: 0.0,
                y_min_m: 0.0,
                cell_m: 0.4,
                width,
                height,
            };
            let maps = AlignedMaps::newest(features, &mask, &facts, &grid);
            fusion.fuse(&maps).unwrap().map
        })
        .collect();
    assert_close(
        name,
        &values(&Tensor::stack(&fused, 0)),
        &golden.f32(name).1,
        1e-4,
        0.0,
    );
}

fn labels_of_dense(positive: &[f32], targets: &[f32]) -> Labels {
    let code = |anchor: usize| {
        std::array::from_fn(|component| f64::from(targets[anchor * BOX_CODE + component]))
    };
    let positives = (0..positive.len()).filter(|&anchor| positive[anchor] > 0.0);
    let positives = positives
        .map(|anchor| Positive {
            anchor,
            code: code(anchor),
        })
        .collect();
    Labels {
        anchors: positive.len(),
        positives,
        unassigned: Vec::new(),
    }
}

fn box_of_hwl(&[x, y, z, h, w, l, yaw]: &[f64; 7]) -> Box3d {
    Box3d {
        center_m: [x, y, z],
        size_m: [l, w, h],
        heading_rad: yaw,
    }
}

/// The upright box of eight corners in the order of [`Box3d::corners`], without its place and size along z.
fn box_of_corners(corners: &[f32; 24]) -> Box3d {
    let [a, b, c, d] =
        std::array::from_fn(|corner| [corners[corner * 3], corners[corner * 3 + 1]].map(f64::from));
    let [x, y] = [0, 1].map(|axis: usize| (a[axis] + b[axis] + c[axis] + d[axis]) / 4.0);
    let [length, width] = [[c, b], [a, b]].map(|[from, to]| [to[0] - from[0], to[1] - from[1]]);
    Box3d {
        center_m: [x, y, 0.0],
        size_m: [length[0].hypot(length[1]), width[0].hypot(width[1]), 1.0],
        heading_rad: length[1].atan2(length[0]),
    }
}

/// The inverse of the planar part of a 4x4 transform.
fn planar_inverse(matrix: &Tensor) -> Pose {
    let entry = |row: i64, column: i64| matrix.double_value(&[row, column]);
    let yaw = entry(1, 0).atan2(entry(0, 0));
    Pose::from_xyz_yaw([entry(0, 3), entry(1, 3), 0.0], yaw)
        .isometry()
        .inverse()
        .into()
}

fn number(golden: &Golden, name: &str) -> f64 {
    golden.config()[name]
        .as_f64()
        .unwrap_or_else(|| panic!("config has no number {name:?}"))
}

fn tensor(golden: &Golden, name: &str) -> Tensor {
    let (shape, values) = golden.f32(name);
    let shape: Vec<i64> = shape.into_iter().map(|size| size as i64).collect();
    Tensor::from_slice(&values).view(shape.as_slice())
}

fn values(tensor: &Tensor) -> Vec<f32> {
    Vec::try_from(tensor.detach().contiguous().view(-1)).unwrap()
}
