//! Pillars and encoder, per sweep. One case: `cargo bench -p perception --bench detector -- voxelise/full/60000`.
//!
//! The encoders run on one torch thread, `full` also on two, the setting of the reference's figure of 0.72 s.

use std::f32::consts::TAU;
use std::hint::black_box;
use std::time::Duration;

use criterion::{Criterion, criterion_group, criterion_main};
use perception::detector::Detector;
use perception::int8::ScaleSearch;
use perception::model_config::DetectorConfig;
use perception::pillars::point_pillars::PointPillars;
use perception::pillars::voxels::Voxeliser;
use protocol::PointCloud;
use support::statistics;
use tch::Device;
use tch::nn::VarStore;

/// A sweep like that of a rotating LiDAR on a street: rings on the ground, walls and cars above it, `count` points.
fn sweep(count: usize, reach_m: f32) -> Vec<[f32; 4]> {
    let rings = 64;
    (0..count)
        .map(|index| {
            let (ring, step) = (index % rings, index / rings);
            let azimuth = step as f32 / (count / rings) as f32 * TAU;
            // Elevations from -25 degrees on: low rings hit the ground, the upper ones walls at a varying distance.
            let slope = (-25.0 + 27.0 * ring as f32 / rings as f32)
                .to_radians()
                .tan();
            let ground = 1.9 / (-slope).max(0.01);
            let wall = 9.0 + 30.0 * (3.0 * azimuth).sin().abs() + 4.0 * (17.0 * azimuth).sin();
            let range = ground.min(wall * reach_m / 40.0).min(reach_m);
            [
                range * azimuth.cos(),
                range * azimuth.sin(),
                (range * slope).max(-1.9),
                0.3,
            ]
        })
        .collect()
}

fn voxelise(criterion: &mut Criterion) {
    for (name, config) in [
        ("full", DetectorConfig::full()),
        ("lean", DetectorConfig::lean()),
    ] {
        let points = sweep(60_000, 100.0);
        let mut voxeliser = Voxeliser::for_detector(&config);
        let pillars = voxeliser.voxelise(&points);
        assert!(
            pillars.len() > 2000 && pillars.points.len() > 10_000,
            "{} {}",
            pillars.len(),
            pillars.points.len()
        );
        criterion.bench_function(&format!("voxelise/{name}/60000"), |bencher| {
            bencher.iter(|| voxeliser.voxelise(black_box(&points)));
        });
    }
}

fn encode(criterion: &mut Criterion) {
    let mut group = criterion.benchmark_group("encode");
    group.sample_size(10);
    let [lean, full] = [DetectorConfig::lean, DetectorConfig::full];
    for (config, threads, is_int8) in [
        (lean(), 1, false),
        (lean(), 1, true),
        (full(), 1, false),
        (full(), 1, true),
        (full(), 2, false),
    ] {
        tch::set_num_threads(threads);
        let network = VarStore::new(Device::Cpu);
        let pillars = PointPillars::new(&network.root(), &config).expect("a preset is valid");
        let mut detector = Detector::from_network(pillars);
        let cloud = PointCloud {
            xyzi: sweep(60_000, 100.0),
        };
        if is_int8 {
            let mut search = ScaleSearch::default();
            detector
                .observe(&cloud, &mut search)
                .expect("a sweep is observed");
            detector = detector
                .quantised(&search.scales())
                .expect("a preset can be quantised");
        }
        let name = format!("{}{}", config.name, if is_int8 { "-int8" } else { "" });
        let mut stages = Vec::new();
        group.bench_function(format!("{name}/{threads}-thread/60000"), |bencher| {
            bencher.iter(|| {
                stages.push(
                    detector
                        .encode(black_box(&cloud))
                        .expect("a sweep is encoded")
                        .times,
                )
            });
        });
        let median = |place: usize| {
            let nanos: Vec<f64> = stages
                .iter()
                .filter_map(|times| Some(times.get(place)?.nanos as f64))
                .collect();
            Duration::from_secs_f64(statistics::median(&nanos).unwrap_or(0.0) * 1e-9)
        };
        let stage = [0, 1, 2].map(median);
        println!(
            "{name} stages: voxelise {:.2?}, pillars {:.2?}, backbone {:.2?}",
            stage[0], stage[1], stage[2]
        );
    }
    group.finish();
}

criterion_group!(benches, voxelise, encode);
criterion_main!(benches);
