//! Checkpoints of the public code bases through the converter, with python3 only.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::process::Command;

use dataset::frame::Frame;
use ego_fuser::ego::Ego;
use ego_fuser_offline::multi_scale::{MapAlignment, MultiScaleNetwork, OfflineDetector};
use fusion::FusionConfig;
use fusion::Method;
use fusion::disconet::DiscoNetConfig;
use fusion::model::CooperativeModel;
use fusion::swap_fusion::SwapFusionConfig;
use fusion::v2vnet::{Aggregation, V2vNetConfig};
use fusion::v2xvit::V2xVitConfig;
use fusion::warp::coalign;
use fusion::where2comm::{self, Missing, Where2commConfig};
use perception::model_config::{BlockKind, DetectorConfig, ShrinkConfig, YAxis};
use perception::pillars::batch::PillarBatch;
use perception::weights::{self, Precision, Weights};
use protocol::{CavId, Handedness, PointCloud, Pose};
use serde_json::{Value, json};
use tch::nn::VarStore;
use tch::{Device, Tensor, no_grad};
use tests::fixtures::{Golden, assert_close, golden};
use tests::tensors::{integer, number, pillars, tensor, values};

const ATOL: f64 = 2e-4;
const RTOL: f64 = 1e-4;

/// Runs the converter: the converted file and its standard output, or its standard error.
fn convert(state: &Path, arguments: &[&str]) -> Result<(PathBuf, String), String> {
    let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("../deploy/tools/convert_opencood.py");
    let out = state.with_extension("converted.safetensors");
    let run = Command::new("python3")
        .arg(script)
        .arg(state)
        .args(arguments)
        .arg("--out")
        .arg(&out)
        .output();
    let output = run.unwrap_or_else(|error| panic!("python3: {error}"));
    let text = |bytes: &[u8]| String::from_utf8_lossy(bytes).into_owned();
    if output.status.success() {
        Ok((out, text(&output.stdout)))
    } else {
        Err(text(&output.stderr))
    }
}

/// A copy of a golden archive, beside which files may be written.
fn copied(name: &str, folder: &Path) -> (Golden, PathBuf) {
    let golden = golden(name);
    let path = folder.join(format!("{name}.safetensors"));
    std::fs::write(&path, golden.bytes()).unwrap();
    (golden, path)
}

#[test]
fn golden_converted_multi_scale_networks_answer_as_the_reference() {
    tch::set_num_threads(1);
    let folder = tempfile::tempdir().unwrap();
    for (name, model) in [
        ("c6_e2e_coalign", "point_pillar_coalign"),
        ("c6_e2e_where2comm_multi", "point_pillar_where2comm"),
    ] {
        let (golden, state) = copied(name, folder.path());
        let slots = golden.f32("in.voxel_features").0[1].to_string();
        let (path, _) = convert(&state, &["--model", model, "--max-points", &slots]).unwrap();
        let network = MultiScaleNetwork::load(&path, Device::Cpu).unwrap();
        let (sweeps, _) = pillars(&golden);
        let batch = PillarBatch::new(
            &sweeps.iter().collect::<Vec<_>>(),
            &network.network.pillar_grid,
        );
        let [width, height, _] = network
            .network
            .config
            .pillar_grid()
            .map(|count| count as i64);
        let cell_m = number(&golden.config()["voxel_size"][0]);
        let normalized =
            coalign::normalized(&tensor(&golden, "in.pairwise"), height, width, cell_m).unwrap();
        let samples: Vec<MapAlignment> = (0..)
            .zip(golden.i64("in.record_len").1)
            .map(|(sample, agents)| {
                let theta = normalized.get(sample).get(0).narrow(0, 0, agents);
                MapAlignment {
                    agents,
                    theta: (!network.config.one_frame).then_some(theta),
                }
            })
            .collect();
        let heads = no_grad(|| network.forward(&batch, &samples)).unwrap().heads;
        assert_close(
            name,
            &values(&heads.scores),
            &golden.f32("out.psm").1,
            ATOL,
            RTOL,
        );
        assert_close(
            name,
            &values(&heads.offsets),
            &golden.f32("out.rm").1,
            ATOL,
            RTOL,
        );
    }
}

#[test]
fn golden_converted_where2comm_of_one_scale_runs_live() {
    tch::set_num_threads(1);
    let folder = tempfile::tempdir().unwrap();
    let (golden, state) = copied("c6_e2e_where2comm_single", folder.path());
    let (path, output) = convert(&state, &["--model", "point_pillar_where2comm"]).unwrap();
    let communication = &golden.config()["where2comm_fusion"]["communication"];
    let threshold = number(&communication["threshold"]);
    assert!(output.contains(&format!("--gate {threshold}")), "{output}");
    let weights = Weights::load(&path).unwrap();
    let config: DetectorConfig = weights.config().unwrap();
    assert_eq!(
        (config.y_axis, config.blocks),
        (YAxis::Right, BlockKind::Plain)
    );
    assert_eq!(
        config.num_filters,
        tests::tensors::integers(&golden.config()["base_bev_backbone"]["num_filters"])
    );
    let shrink = &golden.config()["shrink_header"];
    let (channels, stride) = (integer(&shrink["dim"][0]), integer(&shrink["stride"][0]));
    assert_eq!(
        config.shrink,
        Some(ShrinkConfig::DoubleConv { channels, stride })
    );
    let fusion: FusionConfig = weights.metadata_json("fusion").unwrap();
    let expected = Where2commConfig {
        aggregation: where2comm::MapAggregation::Attention,
        missing: Missing::Zero,
    };
    assert_eq!(fusion, FusionConfig::new(expected));
    assert_eq!(
        Ego::load(&path, None, Device::Cpu).unwrap().method(),
        Method::WHERE2COMM
    );
}

/// Two vehicles with overlapping views of the same street.
fn frames(mirrored: bool) -> [Frame; 2] {
    [0, 1].map(|place| {
        let mut frame = Frame::empty(
            CavId::new(&format!("{place}")).unwrap(),
            0,
            Handedness::Right,
        );
        let pose = Pose::from_xyz_yaw(
            [
                100.0 + 6.0 * f64::from(place),
                50.0 - 2.0 * f64::from(place),
                1.9,
            ],
            0.5,
        );
        let turned = Pose::from_xyz_yaw([0.0; 3], 0.3 * f64::from(place));
        let pose: Pose = (pose.isometry() * turned.isometry()).into();
        frame.world_from_lidar = Some(if mirrored { pose.mirrored_y() } else { pose });
        let point = |k: i32| {
            let y = (k % 31) as f32 * 0.4 - 6.1;
            [
                (k % 57) as f32 * 0.43 - 12.0,
                if mirrored { -y } else { y },
                (k % 7) as f32 * 0.3 - 1.8,
                0.3,
            ]
        };
        frame.points = PointCloud {
            xyzi: (40 * place..1800 + 90 * place).map(point).collect(),
        };
        frame
    })
}

#[test]
fn golden_converted_networks_detect_offline_in_either_world() {
    tch::set_num_threads(1);
    let folder = tempfile::tempdir().unwrap();
    for (name, model) in [
        ("c6_e2e_coalign", "point_pillar_coalign"),
        ("c6_e2e_where2comm_multi", "point_pillar_where2comm"),
    ] {
        let (_, state) = copied(name, folder.path());
        let mut found = Vec::new();
        for (y_axis, mirrored) in [("left", false), ("right", true)] {
            let (converted, _) = convert(&state, &["--model", model, "--y-axis", y_axis]).unwrap();
            let mut detector = OfflineDetector::load(&converted).unwrap();
            let frames = frames(mirrored);
            let (together, bytes) = detector.detect(&frames).unwrap();
            // 16 channels on 16 x 32 cells in `f32`; if cells are left out, a bit for each.
            let whole = 4 * 16 * 16 * 32;
            let fewest = if model == "point_pillar_where2comm" {
                64
            } else {
                whole
            };
            assert!(
                bytes.len() == 1 && (fewest..=whole).contains(&bytes[0]) && bytes[0] % 64 == 0,
                "{name}: {bytes:?}"
            );
            let (ego_only, bytes) = detector.detect(&frames[..1]).unwrap();
            assert!(bytes.is_empty(), "{name}");
            assert!(
                !together.is_empty() && together != ego_only,
                "{name}: {} boxes",
                together.len()
            );
            found.push(together);
        }
        // The output of a network of the mirrored frame for the mirrored street is the mirror image.
        assert_eq!(found[0].len(), found[1].len(), "{name}");
        for (here, there) in found[0].iter().zip(&found[1]) {
            let there = there.box3d.mirrored_y();
            let off = (0..3).map(|axis| (here.box3d.center_m[axis] - there.center_m[axis]).abs());
            assert!(
                off.fold(0.0, f64::max) < 1e-3,
                "{name}: {:?} {there:?}",
                here.box3d
            );
        }
    }
}

/// A state dictionary with the names of the reference around a fusion of this project, as no small ones are published.
fn state_of(
    folder: &Path,
    method: Method,
    fusion: &FusionConfig,
) -> (PathBuf, BTreeMap<String, Tensor>) {
    let detector = DetectorConfig {
        lidar_range_m: [-12.8, -6.4, -3.0, 12.8, 6.4, 1.0],
        layer_nums: vec![1, 1, 1],
        num_filters: vec![8, 12, 16],
        num_upsample_filters: vec![8; 3],
        shrink: Some(ShrinkConfig::DoubleConv {
            channels: 16,
            stride: 2,
        }),
        compress_ratio: Some(4),
        ..DetectorConfig::full()
    };
    let model = CooperativeModel::with_fusion(&detector, method, fusion, Device::Cpu).unwrap();
    let variables: BTreeMap<String, Tensor> = model.variables.variables().into_iter().collect();
    let renamed = VarStore::new(Device::Cpu);
    for (name, tensor) in &variables {
        if name == "steering.weight" {
            continue;
        }
        let name = name.replacen("fusion.", "fusion_net.", 1);
        let parts: Vec<&str> = name.split('.').collect();
        let (last, path) = parts.split_last().unwrap();
        let path = path.iter().fold(renamed.root(), |path, part| path / *part);
        let mut copy = path.zeros_no_train(last, &tensor.size());
        no_grad(|| copy.copy_(tensor));
    }
    let path = folder.join(format!("{method}.safetensors"));
    weights::save(&path, &renamed, &BTreeMap::new(), Precision::Single).unwrap();
    (path, variables)
}

fn hypes(model: &str, more: Value) -> Value {
    let mut args = json!({
        "voxel_size": [0.4, 0.4, 4],
        "lidar_range": [-12.8, -6.4, -3, 12.8, 6.4, 1],
        "anchor_number": 2,
        "compression": 4,
        "pillar_vfe": {"use_norm": true, "num_filters": [64]},
        "base_bev_backbone": {
            "layer_nums": [1, 1, 1], "layer_strides": [2, 2, 2], "num_filters": [8, 12, 16],
            "upsample_strides": [1, 2, 4], "num_upsample_filter": [8, 8, 8]
        },
        "shrink_header": {"kernal_size": [3], "stride": [2], "padding": [1], "dim": [16], "input_dim": 24},
    });
    for (key, value) in more.as_object().unwrap() {
        args[key] = value.clone();
    }
    let preprocess = json!({"args": {"max_points_per_voxel": 20, "max_voxel_test": 5000}});
    let postprocess = json!({"anchor_args": {"l": 4.5, "w": 2, "h": 1.6, "r": [0, 90]}});
    json!({"model": {"core_method": model, "args": args}, "preprocess": preprocess, "postprocess": postprocess})
}

#[test]
fn fusions_with_parameters_come_back_with_every_one() {
    tch::set_num_threads(1);
    let folder = tempfile::tempdir().unwrap();
    let v2vnet = V2vNetConfig {
        aggregation: Aggregation::Max,
        ..V2vNetConfig::full(16)
    };
    let v2vnet_args = json!({"v2vfusion": {
        "num_iteration": 2, "in_channels": 16, "gru_flag": true, "agg_operator": "max",
        "conv_gru": {"H": 16, "W": 32, "num_layers": 1, "kernel_size": [[3, 3]]}
    }});
    let disconet = DiscoNetConfig {
        channels: 16,
        hidden: [24, 12, 6],
    };
    let v2xvit = V2xVitConfig {
        blocks: 2,
        hidden: 24,
        ..V2xVitConfig::lean(16)
    };
    let v2xvit_args = json!({"transformer": {"encoder": {
        "num_blocks": 2, "depth": v2xvit.depth,
        "cav_att_config": {
            "use_hetero": true, "use_RTE": true, "heads": v2xvit.agent_heads,
            "dim_head": v2xvit.agent_head_channels, "dropout": v2xvit.dropout
        },
        "pwindow_att_config": {
            "window_size": v2xvit.windows.iter().map(|window| window.edge).collect::<Vec<_>>(),
            "heads": v2xvit.windows.iter().map(|window| window.heads).collect::<Vec<_>>(),
            "dim_head": v2xvit.windows.iter().map(|window| window.head_channels).collect::<Vec<_>>(),
            "relative_pos_embedding": true, "fusion_method": "split_attn"
        },
        "feed_forward": {"mlp_dim": 24}
    }}});
    let cobevt = SwapFusionConfig {
        count_missing: true,
        hidden: 20,
        ..SwapFusionConfig::lean(16)
    };
    let cobevt_args = json!({"fax_fusion": {
        "mask": true, "depth": cobevt.depth, "agent_size": cobevt.slots, "window_size": cobevt.window,
        "dim_head": cobevt.head_channels, "mlp_dim": 20, "drop_out": cobevt.dropout
    }});
    for (method, fusion, hypes) in [
        (
            Method::V2XVIT,
            FusionConfig::new(v2xvit),
            hypes("point_pillar_transformer", v2xvit_args),
        ),
        (
            Method::COBEVT,
            FusionConfig::new(cobevt),
            hypes("point_pillar_cobevt", cobevt_args),
        ),
        (
            Method::V2VNET,
            FusionConfig::new(v2vnet),
            hypes("point_pillar_v2vnet", v2vnet_args),
        ),
        (
            Method::DISCONET,
            FusionConfig::new(disconet),
            hypes("point_pillar_disconet", json!({})),
        ),
    ] {
        let (state, variables) = state_of(folder.path(), method, &fusion);
        let config = folder.path().join("config.json");
        std::fs::write(&config, hypes.to_string()).unwrap();
        let arguments = ["--config", config.to_str().unwrap(), "--y-axis", "left"];
        let (path, output) = convert(&state, &arguments).unwrap();
        assert!(output.contains("4 of 16 channels"), "{output}");
        let weights = Weights::load(&path).unwrap();
        assert_eq!(
            weights.metadata_json::<FusionConfig>("fusion").unwrap(),
            fusion,
            "{method}"
        );
        let detector: DetectorConfig = weights.config().unwrap();
        assert_eq!(
            (detector.max_points_per_pillar, detector.max_pillars),
            (20, 5000)
        );
        assert_eq!(detector.anchors.size_lwh_m, [4.5, 2.0, 1.6]);
        let model = CooperativeModel::load(&path, None, Device::Cpu).unwrap();
        assert_eq!(model.method, method);
        for (name, found) in model.variables.variables() {
            assert!(
                name == "steering.weight" || found.equal(&variables[&name]),
                "{method}: {name}"
            );
        }
        let ego = Ego::load(&path, None, Device::Cpu).unwrap();
        let (sent, code_of) = (ego.detector().sent_shape(), ego.detector().code_of());
        assert_eq!(
            (ego.method(), sent, code_of),
            (method, [4, 8, 16], Some(16))
        );
    }
}

#[test]
fn what_is_not_understood_is_refused_with_its_name() {
    let folder = tempfile::tempdir().unwrap();
    let state = folder.path().join("broken.safetensors");
    let config = folder.path().join("config.json");
    let with = |hypes: &Value, bytes: &[u8]| {
        std::fs::write(&state, bytes).unwrap();
        std::fs::write(&config, hypes.to_string()).unwrap();
        convert(&state, &["--config", config.to_str().unwrap()]).unwrap_err()
    };
    let empty = b"\x02\0\0\0\0\0\0\0{}";
    let message = with(&hypes("point_pillar_fpvrcnn", json!({})), empty);
    assert!(
        message.contains("config.json") && message.contains("point_pillar_fpvrcnn"),
        "{message}"
    );
    let message = with(&hypes("point_pillar", json!({})), empty);
    assert!(message.contains("pillar encoder"), "{message}");
    let message = with(&hypes("point_pillar", json!({})), &[255; 12]);
    assert!(
        message.contains("broken.safetensors") && message.contains("neither torch nor safetensors"),
        "{message}"
    );
    let message = with(
        &hypes("point_pillar", json!({})),
        b"\xff\xff\xff\x7f\0\0\0\0{}",
    );
    assert!(message.contains("claims"), "{message}");
    let message = with(&json!({"model": {"core_method": "x"}}), empty);
    assert!(message.contains("args"), "{message}");
}
