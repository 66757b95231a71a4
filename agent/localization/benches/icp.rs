//! ICP of two sweeps of a street: fitting the target's planes, decimating the source, registering.
//!
//! `cargo bench -p localization --bench icp`

use std::hint::black_box;

use criterion::{Criterion, criterion_group, criterion_main};
use localization::registration::icp::{IcpConfig, IcpSource, IcpTarget, register};
use nalgebra::{Isometry3, Point3, Vector3};
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;

/// About 50,000 points of ground, house fronts and poles within 60 m of `world_from_sensor`.
fn sweep(world_from_sensor: &Isometry3<f64>, seed: u64) -> Vec<[f32; 4]> {
    let mut random = ChaCha8Rng::seed_from_u64(seed);
    let sensor_from_world = world_from_sensor.inverse();
    let mut points = Vec::with_capacity(50_000);
    while points.len() < 50_000 {
        let mut within = |from: f64, to: f64| random.random_range(from..to);
        let world = match points.len() % 10 {
            0..=4 => Point3::new(within(-60.0, 60.0), within(-9.0, 9.0), 0.0),
            // Houses of 14 m stand at different depths: their gables fix the position along the street.
            5..=8 => {
                let (x, side) = (
                    within(-60.0, 60.0),
                    if points.len() % 2 == 0 { 1.0 } else { -1.0 },
                );
                let house = (x / 14.0).floor();
                match points.len() % 7 {
                    0 => Point3::new(house * 14.0, side * within(10.0, 13.0), within(0.0, 9.0)),
                    _ => Point3::new(x, side * (10.0 + house.rem_euclid(3.0)), within(0.0, 9.0)),
                }
            }
            _ => Point3::new(
                within(-6.0, 6.0).round() * 10.0 + within(0.0, 0.2),
                8.0 + within(0.0, 0.2),
                within(0.0, 6.0),
            ),
        };
        let mut seen = sensor_from_world * world;
        seen.coords += Vector3::from_fn(|_, _| within(-0.03, 0.03));
        points.push([seen.x as f32, seen.y as f32, seen.z as f32, 0.5]);
    }
    points
}

fn icp(criterion: &mut Criterion) {
    let config = IcpConfig::default();
    let pose =
        |x: f64, y: f64, yaw: f64| Isometry3::new(Vector3::new(x, y, 2.0), Vector3::z() * yaw);
    let (here, there) = (pose(0.0, -2.0, 0.0), pose(8.0, 2.0, 0.1));
    let (target, source) = (sweep(&here, 1), sweep(&there, 2));
    let truth = here.inv_mul(&there);
    let start = truth * Isometry3::new(Vector3::new(0.9, -0.7, 0.1), Vector3::z() * 0.03);
    let planes = IcpTarget::of_sweep(&target, &config);
    let decimate = IcpSource::of_sweep(&source);
    let fit = register(&decimate, &planes, &start, &config).expect("a street constrains a pose");
    let off = truth.inv_mul(&fit.target_from_source);
    assert!(off.translation.vector.norm() < 0.1, "{off}");
    eprintln!(
        "{} points on {} planes, {} steps",
        decimate.points_m.len(),
        planes.planes(),
        fit.steps
    );
    criterion.bench_function("icp/target", |bencher| {
        bencher.iter(|| IcpTarget::of_sweep(black_box(&target), &config))
    });
    criterion.bench_function("icp/source", |bencher| {
        bencher.iter(|| IcpSource::of_sweep(black_box(&source)))
    });
    criterion.bench_function("icp/register", |bencher| {
        bencher.iter(|| register(black_box(&decimate), &planes, &start, &config));
    });
}

criterion_group! {
    name = benches;
    config = Criterion::default().sample_size(20);
    targets = icp
}
criterion_main!(benches);
