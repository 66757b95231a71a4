//! Latency of localization, stage by stage, on one thread.
//!
//! `cargo bench -p agent-offline --bench localizer`, or with a filter, for example `-- lean/encode`. The sweep is
//! generated and the weights are random: neither changes the amount of computation. The solver has a bench of its own
//! (`registration`).

use std::hint::black_box;

use criterion::{Criterion, criterion_group, criterion_main};
use dataset::{self, LoadOptions};
use localization::pgc::{
    SceneEncoder, SceneEncoderConfig, SceneHead, SceneHeadConfig, SweepVoxels, VoxelBatch,
};
use simulator::generate::{Subset, SynthOptions, generate};
use tch::nn::VarStore;
use tch::{Device, Kind, Tensor, no_grad};

/// x, y, z of a generated sweep, 50,000 points of it.
fn sweep() -> Vec<[f32; 3]> {
    let dir = tempfile::tempdir().expect("a folder");
    let folder = dir.path().join("drive");
    let options = SynthOptions {
        frames: 1,
        ..SynthOptions::new(Subset::Town1loc, 3, folder.clone())
    };
    generate(&options, &|_| {}).expect("a scene");
    let dataset = dataset::open(&folder).expect("a dataset");
    let frame = dataset.scenarios[0]
        .load(0, 0, &LoadOptions::default())
        .expect("a frame");
    frame
        .points
        .xyzi
        .iter()
        .take(50_000)
        .map(|&[x, y, z, _]| [x, y, z])
        .collect()
}

fn bench(criterion: &mut Criterion) {
    tch::set_num_threads(1);
    let points = sweep();
    for config in [SceneEncoderConfig::lean(), SceneEncoderConfig::full(1.0)] {
        let mut group = criterion.benchmark_group(format!("{}/{}", config.name, points.len()));
        group.sample_size(20);
        group.bench_function("voxelise", |bencher| {
            bencher.iter(|| SweepVoxels::new(black_box(&points).iter().copied(), &config));
        });
        let voxels = SweepVoxels::new(points.iter().copied(), &config);
        let network = VarStore::new(Device::Cpu);
        let encoder = SceneEncoder::new(&network.root(), &config).expect("an encoder");
        group.bench_function("encode", |bencher| {
            bencher.iter(|| {
                let batch = VoxelBatch::new(&[&voxels], &config, Device::Cpu).expect("a batch");
                encoder.encode(&batch, Kind::Float).expect("features")
            });
        });
        let head_config = head_config(&config);
        let head = SceneHead::new(&(network.root() / "head"), &head_config).expect("a head");
        let cells = Tensor::randn(
            [head_config.max_cells as i64, head_config.cell_channels],
            (Kind::Float, Device::Cpu),
        );
        let logits = Tensor::randn(
            [head_config.max_cells as i64, head_config.classes],
            (Kind::Float, Device::Cpu),
        );
        group.bench_function(
            format!("regress {} cells", head_config.max_cells),
            |bencher| {
                bencher.iter(|| {
                    no_grad(|| head.regress(&cells, &logits, Kind::Float)).expect("coordinates")
                });
            },
        );
    }
}

fn head_config(encoder: &SceneEncoderConfig) -> SceneHeadConfig {
    SceneHeadConfig {
        scene_name: "bench".into(),
        encoder_sha256: String::new(),
        cell_channels: encoder.cell_channels(),
        sweep_channels: encoder.sweep_channels(),
        classes: 50,
        centres: 200,
        width: 512,
        blocks: 3,
        origin_m: [0.0; 3],
        max_cells: 1024,
        refiner: None,
        sweep_points: None,
    }
}

criterion_group!(benches, bench);
criterion_main!(benches);
