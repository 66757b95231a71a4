//! One training step of `lean` on synthetic sweeps: time per sample in each precision.
//!
//! `cargo bench -p ego-fuser --bench training_step -- bf16` runs one case.

use std::hint::black_box;

use criterion::{Criterion, Throughput, criterion_group, criterion_main};
use fusion::MapMetadata;
use fusion::Method;
use fusion::model::CooperativeModel;
use perception::compute_precision::ComputePrecision;
use perception::model_config::DetectorConfig;
use perception::pillars::batch::PillarBatch;
use perception::pillars::voxels::{Pillars, Voxeliser};
use perception::train::{AdamW, AdamWConfig};
use protocol::{Box3d, Pose};
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;
use tch::Device;
use training::loss::{LabelTensors, Unassigned, detection_loss};

/// Views of one sample.
const AGENTS: usize = 3;
/// Samples of one step.
const SAMPLES: usize = 2;

/// A sweep with realistic density: rings on the ground, sparser with distance.
fn sweep(rng: &mut impl Rng) -> Vec<[f32; 4]> {
    (0..45_000)
        .map(|_| {
            let range = 3.0f32 * (20.0f32).powf(rng.random());
            let (sin, cos) = rng.random_range(0.0..std::f32::consts::TAU).sin_cos();
            [range * cos, range * sin, rng.random_range(-2.0..0.5), 0.5]
        })
        .collect()
}

fn objects(rng: &mut impl Rng) -> Vec<Box3d> {
    (0..15)
        .map(|_| Box3d {
            center_m: [
                rng.random_range(-45.0..45.0),
                rng.random_range(-35.0..35.0),
                -1.0,
            ],
            size_m: [4.4, 1.9, 1.6],
            heading_rad: rng.random_range(-3.0..3.0),
        })
        .collect()
}

fn training_step(criterion: &mut Criterion) {
    tch::set_num_threads(1);
    let config = DetectorConfig::lean();
    let mut rng = ChaCha8Rng::seed_from_u64(1);
    let mut voxeliser = Voxeliser::for_detector(&config);
    let pillars: Vec<Pillars> = (0..AGENTS * SAMPLES)
        .map(|_| voxeliser.voxelise(&sweep(&mut rng)))
        .collect();
    let poses = [
        Pose::IDENTITY,
        Pose::from_xyz_yaw([12.0, 3.0, 0.0], 0.4),
        Pose::from_xyz_yaw([-20.0, 5.0, 0.0], 3.0),
    ];
    let facts: Vec<_> = poses
        .into_iter()
        .enumerate()
        .map(|(agent, pose)| MapMetadata::fresh(agent, pose))
        .collect();
    let facts = vec![facts; SAMPLES];
    let mut group = criterion.benchmark_group("training_step/lean/2x3");
    group
        .sample_size(10)
        .throughput(Throughput::Elements(SAMPLES as u64));
    for (name, precision) in [
        ("f32", ComputePrecision::F32),
        ("bf16", ComputePrecision::Bf16),
    ] {
        let mut model = CooperativeModel::new(&config, Method::ATTENTION, Device::Cpu)
            .expect("lean is a valid configuration");
        model.set_precision(precision);
        let mut optimizer = AdamW::new(&model.variables, AdamWConfig::default());
        let assigner = model.assigner();
        let labels: Vec<_> = (0..SAMPLES)
            .map(|_| assigner.assign(&objects(&mut rng)))
            .collect();
        let labels = LabelTensors::gather(&labels, Unassigned::Ignored, Device::Cpu);
        let batch = PillarBatch::new(
            &pillars.iter().collect::<Vec<_>>(),
            &model.network.pillar_grid,
        );
        group.bench_function(name, |bencher| {
            bencher.iter(|| {
                let output = model
                    .forward(&batch, &facts, true)
                    .expect("views and facts add up");
                let loss = detection_loss(&output.head.scores, &output.head.offsets, &labels);
                optimizer.zero_grad();
                loss.expect("labels fit").total().backward();
                black_box(optimizer.step(1e-3).expect("gradients are finite"));
            });
        });
    }
    group.finish();
}

criterion_group!(benches, training_step);
criterion_main!(benches);
