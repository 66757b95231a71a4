//! V2VNet, DiscoNet, Where2comm and CoAlign against the reference implementations.

use ego_fuser_offline::multi_scale::{
    MapAlignment, MultiScaleConfig, MultiScaleNetwork, Senders, fuse_levels,
};
use fusion::disconet::{DiscoNet, DiscoNetConfig};
use fusion::v2vnet::{self, Incoming, V2vNet, V2vNetConfig};
use fusion::warp::coalign;
use fusion::where2comm::{
    CommunicationConfig, MapAggregation, Missing, SparseCommunication, Where2comm, Where2commConfig,
};
use fusion::{AlignedMaps, Fusion, MapMetadata};
use perception::layers::backbone::BevBackbone;
use perception::model_config::{BlockKind, DetectorConfig, ShrinkConfig};
use perception::pillars::batch::PillarBatch;
use perception::pillars::point_pillars::PointPillars;
use protocol::{
    BevFeatures, BevGrid, CodecConfig, ConfidenceGate, Limits, Pose, Smoothing, encode_features,
};
use serde_json::Value;
use tch::nn::VarStore;
use tch::{Device, Kind, Tensor, no_grad};
use tests::fixtures::{Golden, assert_close, golden};
use tests::opencood;
use tests::tensors::{detector_config, integer, integers, load, number, pillars, tensor, values};

const ATOL: f64 = 2e-4;
const RTOL: f64 = 1e-4;
/// V2VNet's outputs are about 0.1.
const V2VNET_ATOL: f64 = 2e-5;

#[test]
fn golden_c6_v2vnet() {
    for name in ["c6_v2vnet_avg", "c6_v2vnet_max"] {
        let golden = golden(name);
        let config = golden.config();
        let pixel_m = number(&config["voxel_size"][0]) * number(&config["downsample_rate"]);
        let pairwise = opencood::discretized(&tensor(&golden, "in.pairwise"), pixel_m).unwrap();
        check_v2vnet(&golden, |sample, agents, receiver, [height, width]| {
            let to_receiver = pairwise
                .get(sample)
                .narrow(0, 0, agents)
                .select(1, receiver);
            let centred = opencood::about_centre(&to_receiver, height, width).unwrap();
            Incoming {
                theta: opencood::normalized(&centred, height, width).unwrap(),
                corners_aligned: true,
                // The reference rotates its mask about another point than its maps.
                mask: opencood::rotated_extent(&to_receiver, height, width).unwrap(),
            }
        });
    }
}

#[test]
fn golden_c6_coalign_v2vnet() {
    for name in ["c6_coalign_v2vnet_avg", "c6_coalign_v2vnet_max"] {
        let golden = golden(name);
        let normalized = tensor(&golden, "in.normalized");
        check_v2vnet(&golden, |sample, agents, receiver, [height, width]| {
            let theta = normalized.get(sample).get(receiver).narrow(0, 0, agents);
            let everywhere = Tensor::ones([agents, 1, height, width], (Kind::Float, Device::Cpu));
            let mask = coalign::warp_affine(&everywhere, &theta).unwrap();
            Incoming {
                theta,
                corners_aligned: false,
                mask,
            }
        });
    }
}

fn check_v2vnet(golden: &Golden, incoming: impl Fn(i64, i64, i64, [i64; 2]) -> Incoming) {
    tch::set_num_threads(1);
    let config = golden.config();
    let gru = &config["conv_gru"];
    let kernel = &gru["kernel_size"][0];
    let aggregation = match config["agg_operator"].as_str() {
        Some("avg") => v2vnet::Aggregation::Mean,
        Some("max") => v2vnet::Aggregation::Max,
        other => panic!("unknown operator {other:?}"),
    };
    let with_gru = config["gru_flag"].as_bool().expect("a flag");
    let variables = VarStore::new(Device::Cpu);
    let network = V2vNet::new(
        &variables.root(),
        &V2vNetConfig {
            channels: integer(&config["in_channels"]),
            rounds: integer(&config["num_iteration"]) as usize,
            aggregation,
            gru_layers: if with_gru {
                integer(&gru["num_layers"]) as usize
            } else {
                0
            },
            kernel: integer(&kernel[0]),
        },
    )
    .unwrap();
    load(&variables, golden, "");
    let features = tensor(golden, "in.x");
    let (_, _, height, width) = features.size4().unwrap();
    let (_, agents) = golden.i64("in.record_len");
    let fused: Vec<Tensor> = (0..)
        .zip(features.split_with_sizes(&agents, 0))
        .map(|(sample, maps)| {
            let count = maps.size()[0];
            let incoming: Vec<Incoming> = (0..count)
                .map(|receiver| incoming(sample, count, receiver, [height, width]))
                .collect();
            no_grad(|| network.propagate(&maps, &incoming)).unwrap()
        })
        .collect();
    assert_close(
        "out.y",
        &values(&Tensor::stack(&fused, 0)),
        &golden.f32("out.y").1,
        V2VNET_ATOL,
        RTOL,
    );
}

#[test]
fn golden_c6_coalign_disco() {
    let golden = golden("c6_coalign_disco");
    tch::set_num_threads(1);
    let variables = VarStore::new(Device::Cpu);
    let hidden = [1, 2, 3].map(|layer| {
        golden
            .f32(&format!("w.pixel_weight_layer.conv1_{layer}.bias"))
            .1
            .len() as i64
    });
    let config = DiscoNetConfig {
        channels: integer(&golden.config()["C"]),
        hidden,
    };
    let network = DiscoNet::new(&variables.root(), &config).unwrap();
    load(&variables, &golden, "");
    let (features, normalized) = (tensor(&golden, "in.x"), tensor(&golden, "in.normalized"));
    let (_, agents) = golden.i64("in.record_len");
    let fused: Vec<Tensor> = (0..)
        .zip(features.split_with_sizes(&agents, 0))
        .map(|(sample, maps)| {
            let theta = normalized.get(sample).get(0).narrow(0, 0, maps.size()[0]);
            fuse(&network, &coalign::warp_affine(&maps, &theta).unwrap())
        })
        .collect();
    assert_close(
        "out.y",
        &values(&Tensor::stack(&fused, 0)),
        &golden.f32("out.y").1,
        ATOL,
        RTOL,
    );
}

#[test]
fn golden_c6_where2comm_opencood() {
    let golden = golden("c6_where2comm_opencood");
    tch::set_num_threads(1);
    let (_, agents) = golden.i64("in.record_len");
    let logits = tensor(&golden, "in.psm_single");

    let multi = &golden.config()["multi"];
    let sent = masks(
        &golden,
        "w.fusion.naive_communication.",
        &multi["communication"],
        "threshold",
        &logits,
    );
    assert_rate(&golden, "out.rate", &agents, |sample| share(&sent, sample));
    assert_codec_agrees(&multi["communication"], "threshold", &logits, &sent);
    let sent = exempt(&sent, &agents, |agent| agent == 0);
    assert_eq!(values(&sent), golden.f32("out.masks").1, "masks");
    let samples: Vec<MapAlignment> = agents
        .iter()
        .map(|&agents| MapAlignment {
            agents,
            theta: None,
        })
        .collect();
    let fused = fused_levels(
        &golden,
        &golden.config()["backbone"],
        &samples,
        MapAggregation::Attention,
        &sent,
    );
    assert_close(
        "out.fused",
        &values(&fused),
        &golden.f32("out.fused").1,
        ATOL,
        RTOL,
    );

    let single = &golden.config()["single"];
    let sent = masks(&golden, "", &single["communication"], "threshold", &logits);
    assert_rate(&golden, "single.out.rate", &agents, |sample| {
        share(&sent, sample)
    });
    assert_codec_agrees(&single["communication"], "threshold", &logits, &sent);
    let sent = exempt(&sent, &agents, |agent| agent == 0);
    let maps = tensor(&golden, "single.in.x") * sent;
    let fusion = Where2comm(Where2commConfig {
        aggregation: MapAggregation::Attention,
        missing: Missing::Zero,
    });
    let fused: Vec<Tensor> = maps
        .split_with_sizes(&agents, 0)
        .iter()
        .map(|maps| fuse(&fusion, maps))
        .collect();
    assert_close(
        "single",
        &values(&Tensor::stack(&fused, 0)),
        &golden.f32("single.out.fused").1,
        ATOL,
        RTOL,
    );
}

#[test]
fn golden_c6_where2comm_orig_multi_scale() {
    for name in ["c6_where2comm_orig_atten", "c6_where2comm_orig_max"] {
        let golden = golden(name);
        tch::set_num_threads(1);
        let config = golden.config();
        let (_, agents) = golden.i64("in.record_len");
        let logits = tensor(&golden, "in.confidence");
        let sent = masks(
            &golden,
            "w.fusion.naive_communication.",
            &config["communication"],
            "thre",
            &logits,
        );
        assert_rate(&golden, "out.rate", &agents, |sample| {
            share(&sent, sample.start..sample.start + 1)
        });
        assert_codec_agrees(&config["communication"], "thre", &logits, &sent);
        let sent = exempt(&sent, &agents, |agent| agent % 2 == 0);
        assert_eq!(values(&sent), golden.f32("out.masks").1, "{name}: masks");
        let (_, _, height, width) = tensor(&golden, "in.x").size4().unwrap();
        let samples = placements(
            &golden,
            &agents,
            [height, width],
            &config["downsample_rate"],
        );
        let aggregation = match config["agg_operator"]["mode"].as_str() {
            Some("ATTEN") => MapAggregation::Attention,
            Some("MAX") => MapAggregation::Max,
            other => panic!("unknown operator {other:?}"),
        };
        let fused = fused_levels(&golden, config, &samples, aggregation, &sent);
        assert_close(
            name,
            &values(&fused),
            &golden.f32("out.fused").1,
            ATOL,
            RTOL,
        );
    }
}

#[test]
fn golden_c6_where2comm_orig_single() {
    let golden = golden("c6_where2comm_orig_single");
    let config = golden.config();
    let (_, agents) = golden.i64("in.record_len");
    let logits = tensor(&golden, "in.confidence");
    let sent = masks(&golden, "", &config["communication"], "thre", &logits);
    assert_rate(&golden, "out.rate", &agents, |sample| {
        share(&sent, sample.start..sample.start + 1)
    });
    let sent = exempt(&sent, &agents, |agent| agent % 2 == 0);
    let features = tensor(&golden, "in.x");
    let (_, _, height, width) = features.size4().unwrap();
    let samples = placements(
        &golden,
        &agents,
        [height, width],
        &config["downsample_rate"],
    );
    let fusion = Where2comm(Where2commConfig {
        aggregation: MapAggregation::Attention,
        missing: Missing::Zero,
    });
    let fused: Vec<Tensor> = (0..)
        .zip(features.split_with_sizes(&agents, 0))
        .zip(&samples)
        .map(|((sample, maps), placement)| {
            // The reference masks all maps of sample b by the mask of the b-th map in the batch: an index error.
            let maps = maps * sent.get(sample);
            fuse(
                &fusion,
                &coalign::warp_affine(&maps, placement.theta.as_ref().unwrap()).unwrap(),
            )
        })
        .collect();
    assert_close(
        "out.fused",
        &values(&Tensor::stack(&fused, 0)),
        &golden.f32("out.fused").1,
        ATOL,
        RTOL,
    );
}

#[test]
fn golden_c6_e2e_coalign() {
    let golden = golden("c6_e2e_coalign");
    tch::set_num_threads(1);
    let detector = DetectorConfig {
        blocks: BlockKind::Residual,
        ..detector_config(&golden, "res_bev_backbone")
    };
    let config = MultiScaleConfig {
        aggregation: MapAggregation::Attention,
        communication: None,
        senders: Senders::Neighbours,
        one_frame: false,
    };
    let network = MultiScaleNetwork::new(&detector, &config, Device::Cpu).unwrap();
    load(&network.variables, &golden, "");
    let (_, agents) = golden.i64("in.record_len");
    let [width, height, _] = detector.pillar_grid().map(|count| count as i64);
    let samples = placements(&golden, &agents, [height, width], &Value::from(1));
    check_heads(&golden, &network, &samples);
}

#[test]
fn golden_c6_e2e_where2comm_multi() {
    let golden = golden("c6_e2e_where2comm_multi");
    tch::set_num_threads(1);
    let fusion = &golden.config()["where2comm_fusion"];
    assert_eq!(fusion["multi_scale"], true);
    let config = MultiScaleConfig {
        aggregation: MapAggregation::Attention,
        communication: Some(communication(&fusion["communication"], "threshold")),
        senders: Senders::Neighbours,
        one_frame: true,
    };
    let network =
        MultiScaleNetwork::new(&where2comm_detector(&golden), &config, Device::Cpu).unwrap();
    load(&network.variables, &golden, "");
    let (_, agents) = golden.i64("in.record_len");
    let samples: Vec<MapAlignment> = agents
        .iter()
        .map(|&agents| MapAlignment {
            agents,
            theta: None,
        })
        .collect();
    let rate = check_heads(&golden, &network, &samples);
    assert_eq!(rate as f32, golden.f32("out.com").1[0], "rate");
}

/// At a single scale the published network equals the live one: agents encode and select, the ego fuses and detects.
#[test]
fn golden_c6_e2e_where2comm_single() {
    let golden = golden("c6_e2e_where2comm_single");
    tch::set_num_threads(1);
    let fusion = &golden.config()["where2comm_fusion"];
    assert_eq!(fusion["multi_scale"], false);
    let detector = where2comm_detector(&golden);
    let variables = VarStore::new(Device::Cpu);
    let network = PointPillars::new(&variables.root(), &detector).unwrap();
    load(&variables, &golden, "");
    let (sweeps, _) = pillars(&golden);
    let batch = PillarBatch::new(&sweeps.iter().collect::<Vec<_>>(), &network.pillar_grid);
    let maps = no_grad(|| network.features(&batch, false));
    let confidence = no_grad(|| network.heads(&maps)).unwrap().confidence();
    let gate = gate(&fusion["communication"], "threshold");
    let (_, agents) = golden.i64("in.record_len");
    let [fused, rates] = [0, 1].map(|_| Vec::<Tensor>::new());
    let (mut fused, mut rates) = (fused, rates);
    let fusion = Where2comm(Where2commConfig {
        aggregation: MapAggregation::Attention,
        missing: Missing::Zero,
    });
    let mut first = 0;
    for count in agents {
        let mut received = Vec::new();
        let mut sent_share = Vec::new();
        for agent in first..first + count {
            let (map, share) = through_the_codec(&maps.get(agent), &confidence.get(agent), &gate);
            // The ego's own map is not sent.
            received.push(if agent == first { maps.get(agent) } else { map });
            sent_share.push(share);
        }
        rates.push(Tensor::from(
            sent_share.iter().sum::<f64>() / sent_share.len() as f64,
        ));
        fused.push(fuse(&fusion, &Tensor::stack(&received, 0)));
        first += count;
    }
    let heads = no_grad(|| network.heads(&Tensor::stack(&fused, 0))).unwrap();
    assert_close(
        "psm",
        &values(&heads.scores),
        &golden.f32("out.psm").1,
        ATOL,
        RTOL,
    );
    assert_close(
        "rm",
        &values(&heads.offsets),
        &golden.f32("out.rm").1,
        ATOL,
        RTOL,
    );
    let rate = Tensor::stack(&rates, 0)
        .mean(Kind::Double)
        .double_value(&[]);
    assert_eq!(rate as f32, golden.f32("out.com").1[0], "rate");
}

/// A map `[C, H, W]` after the codec, and the share of its cells.
fn through_the_codec(map: &Tensor, confidence: &Tensor, gate: &ConfidenceGate) -> (Tensor, f64) {
    let (channels, height, width) = map.size3().unwrap();
    let grid = BevGrid {
        x_min_m: 0.0,
        y_min_m: 0.0,
        cell_m: 0.4,
        width: width as u32,
        height: height as u32,
    };
    let features = BevFeatures {
        grid,
        channels: channels as u32,
        code_of: None,
        values: values(map),
    };
    let codec = CodecConfig {
        gate: Some(*gate),
        ..CodecConfig::default()
    };
    let dense = features.values.len() * 4;
    let encoded = encode_features(features, &codec, Some(&values(confidence))).unwrap();
    let bytes = encoded.body.len();
    let received = encoded.decode(&Limits::DEFAULT).unwrap();
    let share = received.sent.map_or(1.0, |sent| {
        let count = sent.iter().filter(|sent| **sent).count();
        assert_eq!(
            bytes,
            sent.len().div_ceil(8) + count * channels as usize * 4,
            "of {dense} bytes"
        );
        count as f64 / sent.len() as f64
    });
    (
        Tensor::from_slice(&received.features.values).view([channels, height, width]),
        share,
    )
}

fn where2comm_detector(golden: &Golden) -> DetectorConfig {
    let shrink = &golden.config()["shrink_header"];
    let (channels, stride) = (integer(&shrink["dim"][0]), integer(&shrink["stride"][0]));
    let shrink = Some(ShrinkConfig::DoubleConv { channels, stride });
    DetectorConfig {
        shrink,
        ..detector_config(golden, "base_bev_backbone")
    }
}

/// Compares both heads, and returns the share of cells that is sent.
fn check_heads(golden: &Golden, network: &MultiScaleNetwork, samples: &[MapAlignment]) -> f64 {
    let (sweeps, _) = pillars(golden);
    let batch = PillarBatch::new(
        &sweeps.iter().collect::<Vec<_>>(),
        &network.network.pillar_grid,
    );
    let output = no_grad(|| network.forward(&batch, samples)).unwrap();
    assert_close(
        "psm",
        &values(&output.heads.scores),
        &golden.f32("out.psm").1,
        ATOL,
        RTOL,
    );
    assert_close(
        "rm",
        &values(&output.heads.offsets),
        &golden.f32("out.rm").1,
        ATOL,
        RTOL,
    );
    output.rate
}

/// Fuses aligned maps that cover the whole grid.
fn fuse(fusion: &dyn Fusion, maps: &Tensor) -> Tensor {
    let (agents, _, height, width) = maps.size4().unwrap();
    let mask = Tensor::ones([agents, 1, height, width], (Kind::Float, Device::Cpu));
    let facts: Vec<_> = (0..agents as usize)
        .map(|agent| MapMetadata::fresh(agent, Pose::IDENTITY))
        .collect();
    let grid = BevGrid {
        x_min_m: 0.0,
        y_min_m: 0.0,
        cell_m: 0.4,
        width: width as u32,
        height: height as u32,
    };
    let maps = AlignedMaps::newest(maps, &mask, &facts, &grid);
    no_grad(|| fusion.fuse(&maps)).unwrap().map
}

/// Poses of maps from the pairwise transforms of a case, `[height, width]` being the size of the map they are made for.
fn placements(
    golden: &Golden,
    agents: &[i64],
    [height, width]: [i64; 2],
    downsampled: &Value,
) -> Vec<MapAlignment> {
    let pixel_m = number(&golden.config()["voxel_size"][0]) * number(downsampled);
    let normalized =
        coalign::normalized(&tensor(golden, "in.pairwise"), height, width, pixel_m).unwrap();
    (0..)
        .zip(agents)
        .map(|(sample, &agents)| {
            let theta = Some(normalized.get(sample).get(0).narrow(0, 0, agents));
            MapAlignment { agents, theta }
        })
        .collect()
}

fn fused_levels(
    golden: &Golden,
    sizes: &Value,
    samples: &[MapAlignment],
    aggregation: MapAggregation,
    sent: &Tensor,
) -> Tensor {
    let canvas = tensor(golden, "in.x");
    let layer_nums: Vec<usize> = integers(&sizes["layer_nums"])
        .iter()
        .map(|&count| count as usize)
        .collect();
    let levels = layer_nums.len();
    let deblock = |level: usize| {
        golden
            .f32(&format!("w.backbone.deblocks.{level}.0.weight"))
            .0
    };
    let config = DetectorConfig {
        pillar_channels: canvas.size()[1],
        layer_nums,
        layer_strides: vec![2; levels],
        num_filters: integers(&sizes["num_filters"]),
        upsample_strides: (0..levels).map(|level| deblock(level)[2] as i64).collect(),
        num_upsample_filters: (0..levels).map(|level| deblock(level)[1] as i64).collect(),
        ..DetectorConfig::full()
    };
    let variables = VarStore::new(Device::Cpu);
    let backbone = BevBackbone::new(&(variables.root() / "backbone"), &config);
    load(&variables, golden, "");
    no_grad(|| fuse_levels(&backbone, &canvas, samples, aggregation, Some(sent))).unwrap()
}

fn gate(config: &Value, threshold: &str) -> ConfidenceGate {
    let smoothing = config.get("gaussian_smooth").map(|smoothing| Smoothing {
        kernel: integer(&smoothing["k_size"]) as u32,
        sigma: number(&smoothing["c_sigma"]) as f32,
    });
    ConfidenceGate {
        threshold: number(&config[threshold]) as f32,
        smoothing,
    }
}

fn communication(config: &Value, threshold: &str) -> CommunicationConfig {
    CommunicationConfig {
        threshold: number(&config[threshold]),
        smoothing: gate(config, threshold).smoothing,
    }
}

/// Masks of the agents of a case, `[N, 1, H, W]`; the window is among its weights below `prefix`.
fn masks(
    golden: &Golden,
    prefix: &str,
    config: &Value,
    threshold: &str,
    logits: &Tensor,
) -> Tensor {
    let variables = VarStore::new(Device::Cpu);
    let communication =
        SparseCommunication::new(&variables.root(), &communication(config, threshold)).unwrap();
    if !variables.variables().is_empty() {
        load(
            &variables,
            golden,
            prefix
                .strip_prefix("w.")
                .expect("names of weights begin with w."),
        );
    }
    no_grad(|| communication.masks(logits)).unwrap()
}

/// The masks with ones for the agents of each sample that send all.
fn exempt(masks: &Tensor, agents: &[i64], sends_all: impl Fn(i64) -> bool) -> Tensor {
    let exempt: Vec<f32> = agents
        .iter()
        .flat_map(|&count| (0..count).map(|agent| f32::from(u8::from(sends_all(agent)))))
        .collect();
    masks.maximum(&Tensor::from_slice(&exempt).view([-1, 1, 1, 1]))
}

/// Share of cells that some agents send.
fn share(masks: &Tensor, agents: std::ops::Range<i64>) -> f64 {
    masks
        .narrow(0, agents.start, agents.end - agents.start)
        .mean(Kind::Double)
        .double_value(&[])
}

fn assert_rate(
    golden: &Golden,
    name: &str,
    agents: &[i64],
    rate: impl Fn(std::ops::Range<i64>) -> f64,
) {
    let mut first = 0;
    let rates = agents.iter().map(|count| {
        first += count;
        rate(first - count..first)
    });
    let found = rates.sum::<f64>() / agents.len() as f64;
    // The reference sums up shares in single precision.
    assert!(
        (found - f64::from(golden.f32(name).1[0])).abs() < 1e-6,
        "{name}: {found}"
    );
}

/// The selection of the codec, in plain numbers with a window of its own, equals that of the network on tensors.
fn assert_codec_agrees(config: &Value, threshold: &str, logits: &Tensor, masks: &Tensor) {
    let gate = gate(config, threshold);
    let confidence = logits.sigmoid().amax([1], false);
    for agent in 0..logits.size()[0] {
        let map = Tensor::ones(
            [1, logits.size()[2], logits.size()[3]],
            (Kind::Float, Device::Cpu),
        );
        let (received, _) = through_the_codec(&map, &confidence.get(agent), &gate);
        assert_eq!(
            values(&received),
            values(&masks.get(agent)),
            "cells of agent {agent}"
        );
    }
}
