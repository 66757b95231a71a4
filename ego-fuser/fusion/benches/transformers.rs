//! V2X-ViT and CoBEVT at their published sizes on two threads, and lean on one: time and share of the machine's peak.
//!
//! `cargo bench -p ego-fuser --bench transformers -- v2xvit/5`
//!
//! Each time is printed with its floating-point operations: those of matrix products (a multiplication and an addition
//! count as two; sums, norms and exponentials as none), the rate per second, and its share of the rate that the machine
//! reaches in the 3x3 convolutions of the encoder.

use std::hint::black_box;
use std::time::Instant;

use bus::malloc_settings;
use criterion::{BenchmarkId, Criterion, criterion_group, criterion_main};
use fusion::cobevt::Cobevt;
use fusion::ermvp::{Ermvp, ErmvpConfig};
use fusion::swap_fusion::SwapFusionConfig;
use fusion::v2xvit::{V2xVit, V2xVitConfig};
use fusion::{AlignedMaps, AttentionFusion, Fusion, MapMetadata};
use protocol::{BevGrid, Pose};
use tch::nn::VarStore;
use tch::{Device, Kind, Tensor, no_grad};

/// Channels, rows and columns of a full-size feature map.
const FULL: [i64; 3] = [256, 48, 176];
/// The same of a lean feature map.
const LEAN: [i64; 3] = [64, 96, 128];
/// GFLOP/s that two threads reach in 3x3 convolutions.
const MACHINE: f64 = 115.0;

/// Operations of V2X-ViT for `agents` agents when only the ego's result is needed, in GFLOP.
fn v2xvit_gflop(config: &V2xVitConfig, agents: i64, cells: i64) -> f64 {
    let (channels, inner) = (
        config.channels,
        config.agent_heads * config.agent_head_channels,
    );
    let key_value = 2 * channels * inner;
    let asking = 2 * channels * inner + 2 * agents * inner;
    let window = |edge: i64, inner: i64| 4 * channels * inner + 2 * edge * edge * inner;
    let windows: i64 = config
        .windows
        .iter()
        .map(|w| window(w.edge, w.heads * w.head_channels))
        .sum();
    let after = windows + 2 * channels * config.hidden;
    let attentions = config.depth as i64 * config.blocks as i64;
    let blocks =
        attentions * agents * key_value + ((attentions - 1) * agents + 1) * (asking + windows);
    let feeds = ((config.depth as i64 - 1) * agents + 1) * (after - windows);
    2e-9 * (cells * (blocks + feeds)) as f64
}

/// The same for CoBEVT, where all agents are computed to the end.
fn cobevt_gflop(config: &SwapFusionConfig, agents: i64, cells: i64) -> f64 {
    let attention = 4 * config.channels * config.channels
        + 2 * agents * config.window * config.window * config.channels;
    let half = attention + 2 * config.channels * config.hidden;
    let head = config.channels * config.channels;
    2e-9 * (cells * (2 * config.depth as i64 * agents * half + head)) as f64
}

/// The same for attention without projections.
fn attention_gflop(agents: i64, [channels, height, width]: [i64; 3]) -> f64 {
    2e-9 * (2 * agents * channels * height * width) as f64
}

fn fuse(criterion: &mut Criterion) {
    // As in the programs.
    malloc_settings::ensure(&malloc_settings::KEPT_MEMORY)
        .expect("this program can be started again");
    tch::set_num_threads(2);
    let [channels, height, width] = FULL;
    let cells = height * width;
    let variables = VarStore::new(Device::Cpu);
    let (vit, cobevt) = (
        V2xVitConfig::full(channels),
        SwapFusionConfig::full(channels),
    );
    let v2xvit_fusion =
        V2xVit::new(&(variables.root() / "v2xvit"), &vit).expect("the published sizes are valid");
    let cobevt_fusion = Cobevt::new(&(variables.root() / "cobevt"), &cobevt)
        .expect("the published sizes are valid");
    for agents in [2, 5] {
        measure(
            criterion,
            "v2xvit",
            &v2xvit_fusion,
            agents,
            FULL,
            v2xvit_gflop(&vit, agents, cells),
        );
    }
    for agents in [2, 5] {
        measure(
            criterion,
            "cobevt",
            &cobevt_fusion,
            agents,
            FULL,
            cobevt_gflop(&cobevt, agents, cells),
        );
    }
    measure(
        criterion,
        "attention",
        &AttentionFusion,
        5,
        FULL,
        attention_gflop(5, FULL),
    );
    tch::set_num_threads(1);
    let [channels, height, width] = LEAN;
    let (vit, cobevt) = (
        V2xVitConfig::lean(channels),
        SwapFusionConfig::lean(channels),
    );
    let lean = VarStore::new(Device::Cpu);
    let ermvp = ErmvpConfig::lean(channels);
    let ermvp_fusion =
        Ermvp::new(&(lean.root() / "ermvp"), &ermvp).expect("the lean sizes are valid");
    let v2xvit_fusion =
        V2xVit::new(&(lean.root() / "v2xvit"), &vit).expect("the lean sizes are valid");
    let cobevt_fusion =
        Cobevt::new(&(lean.root() / "cobevt"), &cobevt).expect("the lean sizes are valid");
    measure(
        criterion,
        "lean-v2xvit",
        &v2xvit_fusion,
        4,
        LEAN,
        v2xvit_gflop(&vit, 4, height * width),
    );
    measure(
        criterion,
        "lean-cobevt",
        &cobevt_fusion,
        4,
        LEAN,
        cobevt_gflop(&cobevt, 4, height * width),
    );
    measure(
        criterion,
        "lean-ermvp",
        &ermvp_fusion,
        4,
        LEAN,
        ermvp_gflop(&ermvp, 4, height * width),
    );
}

/// The queries of ERMVP come from a feature map of a sixteenth of the cells: their cost is left out.
fn ermvp_gflop(config: &ErmvpConfig, agents: i64, cells: i64) -> f64 {
    let channels = config.layers.channels;
    let query = config.layers.depth as i64 * agents * channels * channels;
    cobevt_gflop(&config.layers, agents, cells)
        - 2e-9 * (cells * (query - agents * channels * channels)) as f64
}

fn measure(
    criterion: &mut Criterion,
    name: &str,
    fusion: &dyn Fusion,
    agents: i64,
    shape: [i64; 3],
    gflop: f64,
) {
    let float = (Kind::Float, Device::Cpu);
    let [channels, height, width] = shape;
    let features = Tensor::rand([agents, channels, height, width], float);
    let mask = Tensor::ones([agents, 1, height, width], float);
    let facts: Vec<_> = (0..agents as usize)
        .map(|agent| {
            MapMetadata::fresh(
                agent,
                Pose::from_xyz_yaw([9.0 * agent as f64, 0.0, 0.0], 0.0),
            )
        })
        .collect();
    let grid = BevGrid {
        x_min_m: -140.8,
        y_min_m: -38.4,
        cell_m: 1.6,
        width: width as u32,
        height: height as u32,
    };
    let maps = AlignedMaps::newest(&features, &mask, &facts, &grid);
    let mut best_secs = f64::INFINITY;
    let mut group = criterion.benchmark_group("transformers");
    group.sample_size(10);
    group.bench_function(BenchmarkId::new(name, agents), |bencher| {
        bencher.iter(|| {
            let start = Instant::now();
            let fused = no_grad(|| fusion.fuse(&maps))
                .expect("maps fit together")
                .map;
            best_secs = best_secs.min(start.elapsed().as_secs_f64());
            assert_eq!(fused.size(), shape);
            black_box(fused)
        });
    });
    group.finish();
    if best_secs.is_finite() {
        let rate = gflop / best_secs;
        println!(
            "{name}/{agents}: {gflop:.1} GFLOP in {best_secs:.3} s at best: {rate:.0} GFLOP/s, {:.0} % of {MACHINE}",
            100.0 * rate / MACHINE
        );
    }
}

criterion_group!(benches, fuse);
criterion_main!(benches);
