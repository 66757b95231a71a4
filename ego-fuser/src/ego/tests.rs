use std::path::Path;

use agent::agent::{Agent, AgentInput};
use localization::pose_source::RecordedPose;
use perception::model_config::DetectorConfig;
use perception::pillars::point_pillars::PointPillars;
use perception::weights::{Precision, save};
use protocol::{
    CavId, CodecConfig, ConfidenceGate, EgoMotion, Limits, NoPoseReason, PerceivedObject,
    PointCloud, PoseEstimate, encode_features,
};
use tch::Device;
use tch::nn::VarStore;

use super::*;
use dataset::average_precision::{Ordering, Scorer};
use dataset::ground_truth::GroundTruth;
use fusion::model::CooperativeModel;

/// Capture time of all sweeps unless stated otherwise.
pub(crate) const NOW: u64 = 5_000_000_000;

pub(crate) const HERE: Pose = Pose {
    translation_m: [100.0, 50.0, 2.0],
    rotation_wxyz: [1.0, 0.0, 0.0, 0.0],
};

/// The same network every time, with a head that detects vehicles everywhere, so that there is something to suppress.
pub(crate) fn detector() -> Detector {
    detector_with(None)
}

fn detector_with(compress_ratio: Option<i64>) -> Detector {
    // A small weight of the head, so that scores are spread rather than all close to one.
    detector_of(compress_ratio, 0.3, 0.01)
}

/// The same with scores around the sigmoid of `logit`; `weight` spreads them.
fn detector_of(compress_ratio: Option<i64>, logit: f64, weight: f64) -> Detector {
    tch::set_num_threads(1);
    let lidar_range_m = [-12.8, -6.4, -3.0, 12.8, 6.4, 1.0];
    let config = DetectorConfig {
        lidar_range_m,
        compress_ratio,
        ..DetectorConfig::lean()
    };
    let network = VarStore::new(Device::Cpu);
    let pillars = PointPillars::new(&network.root(), &config).unwrap();
    fill(&network, logit, weight);
    Detector::from_network(pillars)
}

/// The same with most scores between 0.1 and 0.2.
fn unsure_detector() -> Detector {
    detector_of(None, -1.8, 1e-4)
}

/// Sets values from the shapes only: tests that run at the same time share torch's generator.
fn fill(network: &VarStore, logit: f64, weight: f64) {
    for (name, mut variable) in network.variables() {
        let count = variable.numel() as i64;
        let wave = (Tensor::arange(count, (Kind::Float, Device::Cpu)) * 0.7)
            .sin()
            .view(variable.size().as_slice());
        let new = match name.as_str() {
            name if name.contains("running") || name.ends_with("norm.weight") => continue,
            "box_input.out.weight" => wave * 0.0 + 0.5,
            "cls_head.bias" => wave * 0.1 + logit,
            "cls_head.weight" => wave * weight,
            // Boxes are the anchors themselves, which post-processing accepts as vehicles.
            "reg_head.weight" | "reg_head.bias" => wave * 0.0,
            _ if variable.dim() > 1 => {
                wave * (2.0 / (count as f64 / variable.size()[0] as f64).sqrt())
            }
            _ => continue,
        };
        no_grad(|| variable.copy_(&new));
    }
}

fn cloud(phase: f32) -> PointCloud {
    let points = (0..3000).map(|k| {
        [
            (k % 83) as f32 * 0.3 - 12.0 + phase,
            (k % 41) as f32 * 0.3 - 6.0,
            -1.5 + (k % 7) as f32 * 0.1,
            0.2,
        ]
    });
    PointCloud {
        xyzi: points.collect(),
    }
}

pub(crate) fn view(name: &str, world_from_cav: Pose, method: Method, phase: f32) -> View {
    view_by(detector(), name, world_from_cav, method, phase)
}

fn view_by(
    detector: Detector,
    name: &str,
    world_from_cav: Pose,
    method: Method,
    phase: f32,
) -> View {
    let cav = CavId::new(name).unwrap();
    let mut agent = Agent::new(cav.clone(), Box::new(RecordedPose), detector);
    let cloud = cloud(phase);
    let input = AgentInput {
        capture_nanos: 0,
        cloud: &cloud,
        measured_pose: Some(&world_from_cav),
        motion: EgoMotion::default(),
    };
    let output = agent.process(&input).unwrap();
    let content = match method.own_content() {
        Exchange::Boxes => {
            let found = output.perception.detections.into_iter();
            Content::Boxes(found.map(Into::into).collect())
        }
        Exchange::Points => Content::Points(agent.share_points(&cloud)),
        _ => Content::Features(DecodedFeatures {
            features: output.perception.features,
            sent: None,
        }),
    };
    View {
        cav,
        pose: output.pose,
        capture_nanos: NOW,
        content,
    }
}

pub(crate) fn near() -> Pose {
    Pose::from_xyz_yaw([104.0, 51.0, 2.0], 0.3)
}

/// Detections of an ego without neighbours.
fn ego_only(detector: impl Fn() -> Detector, method: Method) -> Vec<Detection> {
    let own = view_by(detector(), "a", HERE, method, 0.0);
    let mut ego = Ego::new(detector(), method).unwrap();
    ego.detect(&own, &[]).unwrap().detections
}

fn detection_at(x: f64, score: f32) -> Detection {
    Detection {
        box3d: protocol::Box3d {
            center_m: [x, 0.0, -1.0],
            size_m: [4.0, 1.8, 1.5],
            heading_rad: 0.0,
        },
        score,
        source: None,
    }
}

fn view_of_boxes(name: &str, world_from_cav: Pose, found: Vec<Detection>) -> View {
    View {
        cav: CavId::new(name).unwrap(),
        pose: PoseEstimate::new(world_from_cav, 1.0),
        capture_nanos: NOW,
        content: Content::Boxes(found.into_iter().map(Into::into).collect()),
    }
}

#[test]
fn a_neighbour_changes_what_is_seen_and_the_same_views_give_the_same_bits() {
    for method in [
        Method::EARLY,
        Method::MAX,
        Method::ATTENTION,
        Method::WHERE2COMM,
        Method::COALIGN,
    ] {
        let (own, other) = (
            view("a", HERE, method, 0.0),
            view("b", near(), method, 0.15),
        );
        let mut ego = Ego::new(detector(), method).unwrap();
        let ego_only = ego.detect(&own, &[]).unwrap();
        let together = ego.detect(&own, std::slice::from_ref(&other)).unwrap();
        assert_eq!(together.fused, [0], "{method}");
        assert!(!together.detections.is_empty(), "{method}");
        assert!(
            ego_only.detections != together.detections,
            "{method}: the neighbour changed nothing"
        );
        let again = Ego::new(detector(), method)
            .unwrap()
            .detect(&own, std::slice::from_ref(&other))
            .unwrap();
        assert_eq!(again.detections, together.detections, "{method}");
    }
}

#[test]
fn ego_only_points_give_the_result_of_the_map_with_a_compressor_too() {
    let [by_map, by_points] =
        [Method::NONE, Method::EARLY].map(|method| ego_only(|| detector_with(Some(4)), method));
    assert!(!by_map.is_empty() && by_map != ego_only(detector, Method::NONE));
    assert_eq!(by_points, by_map);
}

#[test]
fn late_fusion_moves_boxes_and_keeps_the_better_of_two() {
    // The other is 4 m ahead: its box at 1 m is the ego's at 5 m, only it has detected the one at -10 m.
    let own = view_of_boxes("a", HERE, vec![detection_at(5.2, 0.6)]);
    let ahead = Pose {
        translation_m: [104.0, 50.0, 2.0],
        ..HERE
    };
    let found = [(1.0, 0.9), (-10.0, 0.5), (-6.0, 0.05)].map(|(x, score)| detection_at(x, score));
    let other = view_of_boxes("b", ahead, found.into());
    let seen = |is_aligned, other: &View| -> Vec<(f64, String)> {
        let ego = Ego::new(detector(), Method::LATE).unwrap();
        let mut ego = ego.with_box_alignment(is_aligned);
        let output = ego.detect(&own, std::slice::from_ref(other)).unwrap();
        let places = output.detections.iter().map(|found| {
            let source = found.source.as_ref().unwrap();
            (found.box3d.center_m[0].round(), source.as_str().to_owned())
        });
        places.collect()
    };
    let box_of = |x: f64, cav: &str| (x, cav.to_owned());
    for is_aligned in [false, true] {
        let expected = [box_of(5.0, "b"), box_of(-6.0, "b")];
        assert_eq!(seen(is_aligned, &other), expected);
    }
    // Aligned, a late box whose velocity nobody knows does not replace the ego's own.
    let late = View {
        capture_nanos: NOW - 400_000_000,
        ..other
    };
    assert_eq!(seen(false, &late)[0], box_of(5.0, "b"));
    assert_eq!(seen(true, &late), [box_of(5.0, "a")]);
}

#[test]
fn with_none_left_the_maps_of_every_method_are_ego_only() {
    let own = view("a", HERE, Method::NONE, 0.0);
    let ego_only = Ego::new(detector(), Method::NONE)
        .unwrap()
        .detect(&own, &[])
        .unwrap()
        .detections;
    assert!(!ego_only.is_empty());
    let far = view(
        "b",
        Pose::from_xyz_yaw([200.0, 50.0, 2.0], 0.0),
        Method::MAX,
        0.0,
    );
    let lost = View {
        pose: PoseEstimate::NoPose {
            reason: NoPoseReason::NoSource,
            inlier_count: 0,
        },
        ..far.clone()
    };
    for method in [
        Method::MAX,
        Method::ATTENTION,
        Method::WHERE2COMM,
        Method::COALIGN,
        Method::DISCONET,
    ] {
        let output = Ego::new(detector(), method)
            .unwrap()
            .detect(&own, &[far.clone(), lost.clone()])
            .unwrap();
        assert_eq!(output.detections, ego_only, "{method}");
        let reasons = [
            (0, Some(DropReason::OutOfRange)),
            (1, Some(DropReason::NoPose)),
        ];
        assert_eq!(
            (output.fused, output.skipped),
            (vec![], reasons.to_vec()),
            "{method}"
        );
    }
}

/// Methods whose fusion leaves the map of an ego without neighbours unchanged, trained or not; others compute a new
/// map.
fn leaves_one_map_as_it_is(method: Method) -> bool {
    [
        "none",
        "late",
        "early",
        "max",
        "attention",
        "where2comm",
        "coalign",
        "disconet",
    ]
    .contains(&method.name())
}

/// AP@0.3, 0.5 and 0.7 of one frame.
fn average_precisions(detections: &[Detection], objects: &[protocol::Box3d]) -> Vec<Option<f64>> {
    let mut scorer = Scorer::new(&[0.3, 0.5, 0.7]);
    scorer.add(detections, &GroundTruth::of_boxes(objects.iter().copied()));
    scorer.average_precisions(Ordering::Global)
}

/// Writes a TorchScript module that returns the ego's map times `factor`.
fn write_script(file: &Path, factor: f64) {
    let shapes: [&[i64]; 5] = [&[1, 2, 3, 4], &[1, 1, 3, 4], &[1, 3], &[1], &[1]];
    let inputs = shapes.map(|shape| Tensor::ones(shape, (Kind::Float, Device::Cpu)));
    let mut scaled = |inputs: &[Tensor]| {
        let [features, mask, poses, confidence, age_s] = inputs else {
            panic!("{} inputs", inputs.len())
        };
        let unused = (mask.sum(Kind::Float) + poses.sum(Kind::Float)) * 0.0;
        let unused = unused + (confidence.sum(Kind::Float) + age_s.sum(Kind::Float)) * 0.0;
        vec![features.get(0) * factor + unused]
    };
    let module =
        tch::CModule::create_by_tracing("Fusion", "forward", &inputs, &mut scaled).unwrap();
    module.save(file).unwrap();
}

#[test]
fn fused_values_that_are_nan_or_absurd_are_errors_of_the_frame() {
    let folder = tempfile::tempdir().unwrap();
    for (factor, holds) in [
        (1.0, None),
        (f64::NAN, Some("NaN")),
        (f64::INFINITY, Some("NaN")),
        (1e30, Some("000")),
    ] {
        let file = folder.path().join(format!("{factor}.pt"));
        write_script(&file, factor);
        let method: Method = format!("script:{}", file.display()).parse().unwrap();
        let own = view("a", HERE, method, 0.0);
        let found = Ego::new(detector(), method).unwrap().detect(&own, &[]);
        match (found, holds) {
            (Ok(output), None) => assert!(!output.detections.is_empty()),
            (Err(error), Some(holds)) => {
                let text = error.to_string();
                assert!(error.is_of_frame(), "{text}");
                assert!(text.starts_with("the fused feature map holds"), "{text}");
                assert!(text.contains(holds), "{text}");
            }
            (found, _) => panic!("{factor}: {found:?}"),
        }
    }
}

#[test]
fn ego_only_every_method_is_scored_as_none_down_to_the_same_score() {
    // With a threshold above most scores, hardly any box would be scored.
    let expected = ego_only(unsure_detector, Method::NONE);
    let scores: Vec<f32> = expected.iter().map(|found| found.score).collect();
    assert!(
        scores.iter().any(|score| (0.1..0.2).contains(score)),
        "{scores:?}"
    );
    let objects: Vec<_> = expected
        .iter()
        .step_by(2)
        .map(|found| found.box3d)
        .collect();
    for method in Method::ALL
        .into_iter()
        .filter(|method| leaves_one_map_as_it_is(*method))
    {
        let found = ego_only(unsure_detector, method);
        assert_eq!(found.len(), expected.len(), "{method}");
        for (found, expected) in found.iter().zip(&expected) {
            assert_eq!(found.score, expected.score, "{method}");
            let apart = (0..3)
                .map(|axis| (found.box3d.center_m[axis] - expected.box3d.center_m[axis]).abs());
            assert!(
                apart.fold(0.0, f64::max) < 1e-9,
                "{method}: {found:?} is not {expected:?}"
            );
        }
        assert_eq!(
            average_precisions(&found, &objects),
            average_precisions(&expected, &objects),
            "{method}"
        );
    }
}

#[test]
fn an_ego_without_pose_continues_ego_only() {
    let own = view("a", HERE, Method::MAX, 0.0);
    let lost = View {
        pose: PoseEstimate::NoPose {
            reason: NoPoseReason::NoSource,
            inlier_count: 0,
        },
        ..own.clone()
    };
    let mut ego = Ego::new(detector(), Method::MAX).unwrap();
    let output = ego
        .detect(&lost, &[view("b", near(), Method::MAX, 0.1)])
        .unwrap();
    assert_eq!(output.detections, ego.detect(&own, &[]).unwrap().detections);
    assert_eq!(output.skipped, [(0, Some(DropReason::NoPose))]);
}

#[test]
fn cells_that_were_not_sent_have_no_part() {
    let own = view("a", HERE, Method::ATTENTION, 0.0);
    let mut other = view("b", near(), Method::ATTENTION, 0.1);
    let mut ego = Ego::new(detector(), Method::ATTENTION).unwrap();
    let Content::Features(map) = &mut other.content else {
        panic!("attention exchanges maps")
    };
    map.sent = Some(vec![false; map.features.grid.cells()]);
    let output = ego.detect(&own, &[other]).unwrap();
    assert_eq!(output.fused, [0]);
    assert_eq!(output.detections, ego.detect(&own, &[]).unwrap().detections);
}

#[test]
fn unselected_cells_are_not_sent_and_the_rest_is_fused_unchanged() {
    let own = view("a", HERE, Method::WHERE2COMM, 0.0);
    let mut other = view("b", near(), Method::WHERE2COMM, 0.1);
    let Content::Features(map) = &mut other.content else {
        panic!("maps are exchanged")
    };
    let detector = detector();
    let [channels, height, width] = detector.map_shape();
    let whole = Tensor::from_slice(&map.features.values).view([1, channels, height, width]);
    let confidence = detector.heads(&whole).unwrap().confidence;
    let mut distinct = confidence.clone();
    distinct.sort_by(f32::total_cmp);
    distinct.dedup();
    let gate = ConfidenceGate {
        threshold: distinct[distinct.len() * 3 / 4],
        smoothing: None,
    };
    let [dense, sparse] = [None, Some(gate)].map(|gate| {
        let codec = CodecConfig {
            gate,
            ..CodecConfig::default()
        };
        encode_features(map.features.clone(), &codec, Some(&confidence)).unwrap()
    });
    let (dense_bytes, sparse_bytes) = (dense.body.len(), sparse.body.len());
    let received = sparse.decode(&Limits::DEFAULT).unwrap();
    let sent = received
        .sent
        .clone()
        .unwrap()
        .iter()
        .filter(|sent| **sent)
        .count();
    assert_eq!(
        sent,
        confidence
            .iter()
            .filter(|confidence| **confidence > gate.threshold)
            .count()
    );
    assert!(
        (1..confidence.len()).contains(&sent),
        "{sent} of {}",
        confidence.len()
    );
    assert_eq!(
        sparse_bytes,
        confidence.len() / 8 + dense_bytes / confidence.len() * sent
    );
    *map = received;
    let mut ego = Ego::new(detector, Method::WHERE2COMM).unwrap();
    let output = ego.detect(&own, std::slice::from_ref(&other)).unwrap();
    assert_eq!(output.fused, [0]);
    assert!(output.detections != ego.detect(&own, &[]).unwrap().detections);
}

#[test]
fn maps_of_another_network_are_left_out_and_named_where_they_are_the_egos_own() {
    let own = view("a", HERE, Method::MAX, 0.0);
    let mut other = view("b", near(), Method::MAX, 0.1);
    let Content::Features(map) = &mut other.content else {
        panic!("max exchanges maps")
    };
    map.features.channels = 3;
    let mut ego = Ego::new(detector(), Method::MAX).unwrap();
    let output = ego.detect(&own, std::slice::from_ref(&other)).unwrap();
    assert_eq!(output.skipped, [(0, Some(DropReason::Shape))]);
    assert!(
        ego.detect(&other, &[])
            .unwrap_err()
            .to_string()
            .contains("3 x")
    );
    let boxes = View {
        content: Content::Boxes(vec![]),
        ..own.clone()
    };
    assert!(matches!(ego.detect(&boxes, &[]), Err(EgoError::OwnView(_))));
    assert_eq!(
        ego.detect(&own, &[boxes]).unwrap().skipped,
        [(0, Some(DropReason::Shape))]
    );
}

/// The same view for a network without a compressor.
fn decompressed(view: &View) -> View {
    let Content::Features(map) = &view.content else {
        panic!("max exchanges maps")
    };
    let map = detector_with(Some(4)).received(map).unwrap();
    View {
        content: Content::Features(DecodedFeatures {
            features: detector().to_message(&map).unwrap(),
            sent: None,
        }),
        ..view.clone()
    }
}

#[test]
fn codes_are_fused_as_the_maps_that_they_stand_for_and_no_others() {
    let own = view_by(detector_with(Some(4)), "a", HERE, Method::MAX, 0.0);
    let other = view_by(detector_with(Some(4)), "b", near(), Method::MAX, 0.1);
    let Content::Features(map) = &other.content else {
        panic!("max exchanges maps")
    };
    assert_eq!(
        (map.features.channels, map.features.code_of),
        (16, Some(64))
    );
    let mut ego = Ego::new(detector_with(Some(4)), Method::MAX).unwrap();
    let together = ego.detect(&own, std::slice::from_ref(&other)).unwrap();
    assert_eq!(together.fused, [0]);
    // The same network without a compressor is given the decompressed maps.
    let mut plain = Ego::new(detector(), Method::MAX).unwrap();
    assert_eq!(
        plain
            .detect(&decompressed(&own), &[decompressed(&other)])
            .unwrap()
            .detections,
        together.detections
    );
    // As many channels, but of another map; and a map where a compressed code is expected.
    let mut of_another = other.clone();
    let Content::Features(map) = &mut of_another.content else {
        panic!("max exchanges maps")
    };
    map.features.code_of = Some(128);
    let mismatched = [
        of_another,
        decompressed(&other),
        view_by(detector_with(Some(8)), "b", near(), Method::MAX, 0.1),
    ];
    let skipped = ego.detect(&own, &mismatched).unwrap().skipped;
    assert_eq!(
        skipped,
        [0, 1, 2].map(|index| (index, Some(DropReason::Shape)))
    );
}

/// The ego's view of a frame, `x_m` ahead of [`HERE`].
fn moving_view(frame: u64, x_m: f64) -> View {
    View {
        capture_nanos: NOW + frame * 100_000_000,
        pose: PoseEstimate::new(Pose::from_xyz_yaw([100.0 + x_m, 50.0, 2.0], 0.0), 0.9),
        ..view("a", HERE, Method::PASTAT, 0.0)
    }
}

/// Views whose senders are at the ego's pose.
fn aligned_here<'a>(own: &'a View, other: &'a View) -> [Aligned<'a>; 2] {
    [own, other].map(|view| Aligned {
        view,
        ego_from_cav: Pose::IDENTITY,
    })
}

#[test]
fn maps_of_earlier_frames_are_moved_by_the_egos_motion_and_come_in_once() {
    let mut ego = Ego::new(detector(), Method::PASTAT).unwrap();
    assert_eq!(ego.fusion.requirements.history.frames, 3);
    let other = view("b", near(), Method::PASTAT, 0.15);
    let (first, second) = (moving_view(0, 0.0), moving_view(1, 2.0));
    ego.detect(&first, std::slice::from_ref(&other)).unwrap();
    // The neighbour has no newer message: its message serves again, and is not its own history.
    let earlier = ego
        .earlier(&aligned_here(&second, &other))
        .into_iter()
        .map(|(_, metadata)| (metadata.agent, metadata.ego_from_cav));
    let earlier: Vec<_> = earlier.collect();
    assert_eq!(earlier.len(), 1);
    let (agent, place) = earlier[0];
    assert_eq!(agent, 0);
    assert!(
        (place.translation_m[0] + 2.0).abs() < 1e-9,
        "what was here lies 2 m behind now"
    );
    ego.detect(&second, std::slice::from_ref(&other)).unwrap();
    let later = View {
        capture_nanos: NOW + 150_000_000,
        ..view("b", near(), Method::PASTAT, 0.15)
    };
    let third = moving_view(2, 4.0);
    let agents: Vec<usize> = ego
        .earlier(&aligned_here(&third, &later))
        .into_iter()
        .map(|(_, metadata)| metadata.agent)
        .collect();
    assert_eq!(agents, [0, 0, 1]);
    let lost = View {
        pose: PoseEstimate::NoPose {
            reason: NoPoseReason::NoSource,
            inlier_count: 0,
        },
        ..third.clone()
    };
    assert!(ego.earlier(&aligned_here(&lost, &later)).is_empty());
    ego.forget();
    assert!(ego.earlier(&aligned_here(&third, &later)).is_empty());
}

/// The ego of a model that is written to a file.
fn ego_of_file(file: &Path, model: &CooperativeModel) -> Ego {
    save(file, &model.variables, &model.about(), Precision::Single).unwrap();
    Ego::from_weights(&Weights::load(file).unwrap(), None, Device::Cpu).unwrap()
}

/// Egos of `method` from files of the same weights, without and with a box input.
pub(crate) fn egos_of_files(method: Method) -> [Ego; 2] {
    let config = detector().config().clone();
    let [without, mut with] =
        [(); 2].map(|()| CooperativeModel::new(&config, method, Device::Cpu).unwrap());
    with.train_box_input_only().unwrap();
    fill(&with.variables, 0.3, 1e-4);
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("weights.safetensors");
    let with = ego_of_file(&path, &with);
    let weights = Weights::load(&path).unwrap();
    weights
        .copy_some_into(&without.variables, |_| true)
        .unwrap();
    [ego_of_file(&path, &without), with]
}

#[test]
fn boxes_of_a_neighbour_count_where_the_weights_read_them_and_change_nothing_else() {
    for method in [Method::MAX, Method::PASTAT] {
        let [own, map] = [("a", HERE, 0.0), ("b", near(), 0.15)]
            .map(|(name, pose, phase)| view(name, pose, method, phase));
        let boxes = View {
            content: Content::Boxes(vec![PerceivedObject::from(Detection {
                box3d: protocol::Box3d {
                    center_m: [2.0, 1.0, -1.0],
                    size_m: [4.0, 1.8, 1.6],
                    heading_rad: 0.4,
                },
                score: 0.9,
                source: None,
            })]),
            ..view("c", near(), method, 0.0)
        };
        let mut egos = egos_of_files(method);
        let mut detect = |reads_boxes, neighbours: &[&View]| {
            let neighbours: Vec<View> = neighbours.iter().copied().cloned().collect();
            let ego = &mut egos[usize::from(reads_boxes)];
            ego.forget();
            ego.detect(&own, &neighbours).unwrap()
        };
        for neighbours in [&[][..], &[&map]] {
            let [with, without] = [true, false].map(|reads| detect(reads, neighbours));
            assert_eq!(with.detections, without.detections, "{method}");
        }
        let refused = detect(false, &[&boxes]);
        let shape = Some(DropReason::Shape);
        assert_eq!((refused.fused, refused.skipped), (vec![], vec![(0, shape)]));
        let read = detect(true, &[&boxes, &map]);
        assert_eq!(read.fused, [0, 1], "{method}");
        assert_ne!(
            read.detections,
            detect(true, &[&map]).detections,
            "{method}"
        );
        assert_ne!(
            detect(true, &[&boxes]).detections,
            detect(true, &[]).detections
        );

        // Of one neighbour map and boxes count, and its boxes alone where the map does not.
        let same = View {
            cav: map.cav.clone(),
            ..boxes.clone()
        };
        let both = detect(true, &[&same, &map]);
        assert_eq!((both.fused, both.skipped), (vec![0, 1], vec![]));
        assert_eq!(both.detections, read.detections);
        let late = View {
            capture_nanos: map.capture_nanos.saturating_sub(200_000_000),
            ..map.clone()
        };
        let newer = detect(true, &[&same, &late]);
        let unneeded = Some(DropReason::Unneeded);
        assert_eq!((newer.fused, newer.skipped), (vec![0], vec![(1, unneeded)]));
        let mut foreign = map.clone();
        if let Content::Features(map) = &mut foreign.content {
            map.features.channels += 1;
        }
        let from_boxes = detect(true, &[&same, &foreign]);
        assert_eq!(
            (from_boxes.fused, from_boxes.skipped),
            (vec![0], vec![(1, shape)])
        );
        assert_eq!(from_boxes.detections, detect(true, &[&boxes]).detections);
    }
}

/// Vehicles on a raster, the less likely the higher the number.
fn numbered_car(number: u16) -> PerceivedObject {
    let [x, y] = [number % 16, number / 16 % 16].map(f64::from);
    PerceivedObject::from(Detection {
        box3d: protocol::Box3d {
            center_m: [x - 8.0, y - 8.0, -1.0],
            size_m: [4.0, 1.8, 1.6],
            heading_rad: 0.4,
        },
        score: 1.0 - f32::from(number) / 2000.0,
        source: None,
    })
}

#[test]
fn of_a_flood_as_many_boxes_are_read_as_the_ego_detects_and_a_few_more() {
    let [_, mut ego] = egos_of_files(Method::MAX);
    let own = view("a", HERE, Method::MAX, 0.0);
    let Content::Features(map) = &own.content else {
        panic!("{own:?}")
    };
    let seen = boxes_in(&ego.tensors(map, true).unwrap().0, &ego.detector).unwrap();
    let mut detect = |count: u16| {
        let sender = View {
            cav: CavId::new("b").unwrap(),
            content: Content::Boxes((0..count).map(numbered_car).collect()),
            ..own.clone()
        };
        ego.forget();
        let output = ego.detect(&own, &[sender]).unwrap();
        (output.detections, output.refused_boxes)
    };
    let most = u16::try_from(seen.len() + MORE_BOXES).unwrap();
    let (read, refused) = detect(most);
    assert_eq!(refused, 0);
    assert_ne!(detect(16).0, read);
    assert_eq!(detect(1000), (read, 1000 - usize::from(most)));
}

#[test]
fn boxes_are_placed_where_the_ego_detects_them_too() {
    let [_, ego] = egos_of_files(Method::MAX);
    let own = view("a", HERE, Method::MAX, 0.0);
    let Content::Features(map) = &own.content else {
        panic!("{own:?}")
    };
    let map = ego.tensors(map, true).unwrap().0;
    let seen = boxes_in(&map, &ego.detector).unwrap();
    // What the ego detects, as a vehicle sends it that is 4 m ahead and states to be a metre off.
    let ego_from_cav = Pose::from_xyz_yaw([4.0, 1.0, 0.0], 0.0);
    let objects = seen.into_iter().map(|found| {
        let box3d = found.box3d.transformed(&ego_from_cav.isometry().inverse());
        PerceivedObject::from(Detection { box3d, ..found })
    });
    let sender = View {
        cav: CavId::new("b").unwrap(),
        content: Content::Boxes(objects.collect()),
        ..own.clone()
    };
    let stated = Pose::from_xyz_yaw([4.8, 0.4, 0.0], 0.0);
    let mut aligned = [(&own, Pose::IDENTITY), (&sender, stated)]
        .map(|(view, ego_from_cav)| Aligned { view, ego_from_cav });
    let mut stages = StageTimes::start();
    ego.correct_poses_of_boxes(&mut aligned, &mut stages)
        .unwrap();
    let [x, y, _] = aligned[1].ego_from_cav.translation_m;
    assert!((x - 4.0).abs() < 0.2 && (y - 1.0).abs() < 0.2, "{x} {y}");
    assert_eq!(aligned[0].ego_from_cav, Pose::IDENTITY);
    assert_eq!(stages.into_timings()[0].stage, "correct");
}
