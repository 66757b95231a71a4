//! V2X-ViT and CoBEVT against the reference implementations.

use fusion::swap_fusion::{Slots, SwapFusion, SwapFusionConfig};
use fusion::v2xvit::{AgentAttention, Encoder, Merge, V2xVitConfig, WindowAttention, WindowConfig};
use fusion::warp::coalign;
use fusion::{BlockOrder, layers::unseen};
use serde_json::Value;
use tch::nn::VarStore;
use tch::{Device, Kind, Tensor, no_grad};
use tests::fixtures::{Golden, assert_close, golden};
use tests::opencood;
use tests::tensors::{integer, integers, number, tensor, values};

/// Tolerance of the V2X-ViT fixtures.
const ATOL: f64 = 2e-4;
const RTOL: f64 = 1e-4;
/// State of the references on which no result depends.
const UNUSED: [&str; 2] = ["prior_feed.", "relative_position_index"];

#[test]
fn golden_c6_v2xvit_naive() {
    check_v2xvit("c6_v2xvit_naive");
}

#[test]
fn golden_c6_v2xvit_split_attn() {
    check_v2xvit("c6_v2xvit_split_attn");
}

fn check_v2xvit(name: &str) {
    let golden = golden(name);
    tch::set_num_threads(1);
    let case = EncoderCase::new(&golden, &golden.config()["encoder"], "");
    let (x, prior) = (tensor(&golden, "in.x"), tensor(&golden, "in.prior"));
    let (present, correction) = (
        tensor(&golden, "in.mask"),
        tensor(&golden, "in.spatial_correction"),
    );
    let &[samples, slots, height, width, _] = &x.size()[..] else {
        panic!("five dimensions")
    };
    let features = x.narrow(4, 0, case.config.channels);

    let encoded = Tensor::stack(
        &(0..samples)
            .map(|b| case.with_delay(&features.get(b), &prior.get(b)))
            .collect::<Vec<_>>(),
        0,
    );
    case.close("mid.rte", &encoded);
    let moved = opencood::spatial_correction(&encoded, &correction, case.pixel_m).unwrap();
    case.close("mid.sttf_agent1", &moved.select(1, 1));
    let mask = if case.use_roi_mask {
        opencood::roi_mask(&correction, &present, height, width, case.pixel_m).unwrap()
    } else {
        present
            .view([samples, slots, 1, 1])
            .expand([samples, slots, height, width], false)
            .contiguous()
    };
    case.close("mid.com_mask", &mask.permute([0, 2, 3, 1]).unsqueeze(3));

    let mut stages: [Vec<Tensor>; 3] = Default::default();
    for sample in 0..samples {
        // Slots without an agent are not computed; no output of the ego depends on them.
        let agents = present.get(sample).sum(Kind::Int64).int64_value(&[]);
        let maps = moved.get(sample).narrow(0, 0, agents).permute([0, 3, 1, 2]);
        let types: Vec<usize> = (0..agents)
            .map(|agent| prior.double_value(&[sample, agent, 2]) as usize)
            .collect();
        let tokens = case.order.tokens(&maps).unwrap();
        let unseen = unseen(&mask.get(sample).narrow(0, 0, agents).unsqueeze(1)).unwrap();
        let unseen = case.order.tokens(&unseen).unwrap().squeeze_dim(2);
        let block = &case.encoder.layers[0].blocks[0];
        let one = block
            .across_agents(&tokens, Some(&unseen), &types, agents as usize, false)
            .unwrap()
            .get(0);
        let two = block.across_cells(&one, false).unwrap();
        let all = case
            .encoder
            .forward(&tokens, Some(&unseen), &types, false)
            .unwrap();
        let trained = no_grad(|| case.encoder.forward(&tokens, Some(&unseen), &types, true));
        assert!(trained.is_ok(), "the way of training");
        for (stage, tokens) in stages.iter_mut().zip([one, two, all]) {
            stage.push(
                case.order
                    .maps(&tokens.unsqueeze(0), height, width)
                    .unwrap()
                    .get(0)
                    .permute([1, 2, 0]),
            );
        }
    }
    let names = [
        "mid.after_first_hmsa_ego",
        "mid.after_first_window_ego",
        "out.y",
    ];
    for (name, stage) in names.into_iter().zip(stages) {
        case.close(name, &Tensor::stack(&stage, 0));
    }
}

#[test]
fn golden_c6_coalign_v2xvit() {
    let golden = golden("c6_coalign_v2xvit");
    tch::set_num_threads(1);
    let case = EncoderCase::new(&golden, &golden.config()["encoder"], "fusion_net.");
    let (x, matrices) = (tensor(&golden, "in.x"), tensor(&golden, "in.normalized"));
    let [.., height, width] = x.size()[..] else {
        panic!("four dimensions")
    };
    let (_, agents) = golden.i64("in.record_len");
    let mut fused = Vec::new();
    for (sample, maps) in x
        .split_with_sizes(agents.as_slice(), 0)
        .into_iter()
        .enumerate()
    {
        let matrices = matrices
            .get(sample as i64)
            .get(0)
            .narrow(0, 0, maps.size()[0]);
        let tokens = case
            .order
            .tokens(&coalign::warp_affine(&maps, &matrices).unwrap())
            .unwrap();
        let types = vec![0; maps.size()[0] as usize];
        let ego = case.encoder.forward(&tokens, None, &types, false).unwrap();
        fused.push(
            case.order
                .maps(&ego.unsqueeze(0), height, width)
                .unwrap()
                .get(0),
        );
    }
    case.close("out.y", &Tensor::stack(&fused, 0));
}

#[test]
fn golden_c6_hmsa_mswin() {
    let golden = golden("c6_hmsa_mswin");
    tch::set_num_threads(1);
    let config = golden.config();
    let variables = VarStore::new(Device::Cpu);
    let root = variables.root();
    let channels = integer(&config["dim"]);
    let windows = windows(&config["heads"], &config["dim_head"], &config["window"]);
    let edges: Vec<i64> = windows.iter().map(|window| window.edge).collect();
    let order = BlockOrder::new(&edges).expect("the windows nest");
    let agents = AgentAttention::new(
        &(&root / "hmsa"),
        channels,
        integer(&config["hmsa_heads"]),
        integer(&config["hmsa_dim_head"]),
        0.0,
    );
    let cells = WindowAttention::new(
        &(&root / "mswin"),
        channels,
        &windows,
        Merge::SplitAttention,
        &order,
        0.0,
    );
    load(&variables, &golden, "");
    let (x, prior, mask) = (
        tensor(&golden, "in.x"),
        tensor(&golden, "in.prior"),
        tensor(&golden, "in.mask"),
    );
    let &[samples, slots, height, width, _] = &x.size()[..] else {
        panic!("five dimensions")
    };
    let mut found: [Vec<Tensor>; 3] = Default::default();
    for sample in 0..samples {
        let tokens = order.tokens(&x.get(sample).permute([0, 3, 1, 2])).unwrap();
        let mask = mask.get(sample).permute([3, 2, 0, 1]);
        let unseen = order
            .tokens(&unseen(&mask).unwrap())
            .unwrap()
            .squeeze_dim(2);
        let types: Vec<usize> = (0..slots)
            .map(|slot| prior.double_value(&[sample, slot, 0, 0, 2]) as usize)
            .collect();
        let all = agents
            .forward(&tokens, Some(&unseen), &types, types.len(), false)
            .unwrap();
        let ego = agents
            .forward(&tokens, Some(&unseen), &types, 1, false)
            .unwrap();
        assert_close(
            "ego-only",
            &values(&ego.get(0)),
            &values(&all.get(0)),
            1e-5,
            0.0,
        );
        let each = |step: &dyn Fn(&Tensor) -> Tensor| {
            Tensor::stack(
                &(0..slots)
                    .map(|slot| step(&tokens.get(slot)))
                    .collect::<Vec<_>>(),
                0,
            )
        };
        let merged = each(&|x| cells.forward(x, false).unwrap());
        let branch = each(&|x| cells.branches[1].forward(x).unwrap());
        for (found, tokens) in found.iter_mut().zip([all, merged, branch]) {
            found.push(
                order
                    .maps(&tokens, height, width)
                    .unwrap()
                    .permute([0, 2, 3, 1]),
            );
        }
    }
    for (name, found) in ["out.hmsa", "out.mswin", "out.window_branch1"]
        .into_iter()
        .zip(found)
    {
        close(&golden, name, &Tensor::stack(&found, 0), ATOL, RTOL);
    }
}

#[test]
fn golden_c6_swapfusion_mask() {
    check_swap_fusion("c6_swapfusion_mask");
}

#[test]
fn golden_c6_swapfusion_nomask() {
    check_swap_fusion("c6_swapfusion_nomask");
}

fn check_swap_fusion(name: &str) {
    let golden = golden(name);
    tch::set_num_threads(1);
    let config = golden.config();
    let size = |name: &str| integer(&config[name]);
    let masked = config["mask"].as_bool().expect("mask is true or false");
    let cobevt = SwapFusionConfig {
        channels: size("input_dim"),
        depth: size("depth") as usize,
        slots: size("agent_size"),
        window: size("window_size"),
        head_channels: size("dim_head"),
        hidden: size("mlp_dim"),
        count_missing: true,
        dropout: 0.0,
    };
    cobevt.validate().unwrap();
    let variables = VarStore::new(Device::Cpu);
    let fusion = SwapFusion::new(&variables.root(), &cobevt, masked);
    load(&variables, &golden, "");
    let (x, mask) = (tensor(&golden, "in.x"), tensor(&golden, "in.mask"));
    let (mut first, mut fused, mut trained) = (Vec::new(), Vec::new(), Vec::new());
    for (sample, agents) in integers(&config["agents"]).into_iter().enumerate() {
        let maps = x.get(sample as i64);
        let reach = mask.get(sample as i64).squeeze_dim(2).permute([2, 0, 1]);
        // Without the mask, slots without an agent are agents with empty maps.
        let slots = Slots {
            asked: if masked { agents } else { cobevt.slots },
            reach: masked.then_some(&reach),
            count_missing: true,
        };
        first.push(fusion.after_layers(&maps, slots, 1).unwrap().get(0));
        fused.push(fusion.forward(&maps, slots, false).unwrap());
        trained.push(no_grad(|| fusion.forward(&maps, slots, true)).unwrap());
    }
    close(
        &golden,
        "out.first_block_ego",
        &Tensor::stack(&first, 0),
        1e-4,
        0.0,
    );
    close(&golden, "out.y", &Tensor::stack(&fused, 0), 1e-4, 0.0);
    close(&golden, "out.y", &Tensor::stack(&trained, 0), 1e-4, 0.0);
}

/// An encoder with the weights of a case.
struct EncoderCase<'a> {
    golden: &'a Golden,
    config: V2xVitConfig,
    order: BlockOrder,
    encoder: Encoder,
    pixel_m: f64,
    rows_per_step: f64,
    use_roi_mask: bool,
}

impl<'a> EncoderCase<'a> {
    fn new(golden: &'a Golden, encoder: &Value, prefix: &str) -> Self {
        let (agents, cells) = (&encoder["cav_att_config"], &encoder["pwindow_att_config"]);
        assert_eq!(agents["use_hetero"], true);
        assert_eq!(cells["relative_pos_embedding"], true);
        let config = V2xVitConfig {
            channels: integer(&agents["dim"]),
            depth: integer(&encoder["depth"]) as usize,
            blocks: integer(&encoder["num_blocks"]) as usize,
            agent_heads: integer(&agents["heads"]),
            agent_head_channels: integer(&agents["dim_head"]),
            windows: windows(&cells["heads"], &cells["dim_head"], &cells["window_size"]),
            merge: if cells["fusion_method"] == "naive" {
                Merge::Naive
            } else {
                Merge::SplitAttention
            },
            hidden: integer(&encoder["feed_forward"]["mlp_dim"]),
            temporal_encoding: agents["use_RTE"]
                .as_bool()
                .expect("use_RTE is true or false"),
            dropout: 0.0,
        };
        config.validate().unwrap();
        let order = config.order().unwrap();
        let variables = VarStore::new(Device::Cpu);
        let built = Encoder::new(&(variables.root() / "encoder"), &config, &order);
        load(&variables, golden, prefix);
        let sttf = &encoder["sttf"];
        Self {
            golden,
            config,
            order,
            encoder: built,
            pixel_m: number(&sttf["voxel_size"][0]) * number(&sttf["downsample_rate"]),
            rows_per_step: number(&agents["RTE_ratio"]),
            use_roi_mask: encoder["use_roi_mask"].as_bool().unwrap(),
        }
    }

    /// `[L, H, W, C]` with the code of each slot's delay.
    fn with_delay(&self, features: &Tensor, prior: &Tensor) -> Tensor {
        let Some(temporal) = &self.encoder.temporal else {
            return features.shallow_clone();
        };
        let slots = features.size()[0];
        let rows: Vec<f64> = (0..slots)
            .map(|slot| prior.double_value(&[slot, 1]).trunc() * self.rows_per_step)
            .collect();
        features + temporal.encode(&rows).unwrap().view([slots, 1, 1, -1])
    }

    fn close(&self, name: &str, found: &Tensor) {
        close(self.golden, name, found, ATOL, RTOL);
    }
}

fn windows(heads: &Value, head_channels: &Value, edges: &Value) -> Vec<WindowConfig> {
    let sizes = integers(edges)
        .into_iter()
        .zip(integers(heads))
        .zip(integers(head_channels));
    sizes
        .map(|((edge, heads), head_channels)| WindowConfig {
            edge,
            heads,
            head_channels,
        })
        .collect()
}

/// Copies the weights of a case, all of them, into variables without `prefix` in their names.
fn load(variables: &VarStore, golden: &Golden, prefix: &str) {
    let mut variables = variables.variables();
    let prefix = format!("w.{prefix}");
    for name in golden.names() {
        let Some(short) = name.strip_prefix(&prefix) else {
            continue;
        };
        match variables.remove(short) {
            Some(mut variable) => {
                let source = tensor(golden, &name);
                assert_eq!(source.size(), variable.size(), "{name}");
                no_grad(|| variable.copy_(&source));
            }
            None => assert!(
                UNUSED.iter().any(|unused| short.contains(unused)),
                "nothing takes {name}"
            ),
        }
    }
    assert!(
        variables.is_empty(),
        "not in the archive: {:?}",
        variables.keys()
    );
}

fn close(golden: &Golden, name: &str, found: &Tensor, atol: f64, rtol: f64) {
    assert_eq!(found.size(), tensor(golden, name).size(), "shape of {name}");
    assert_close(name, &values(found), &golden.f32(name).1, atol, rtol);
}
