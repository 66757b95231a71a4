//! Boxes: rotated suppression and decoding. One case: `cargo bench -p perception --bench boxes -- nms/clusters/1000`.

use std::hint::black_box;

use criterion::{Criterion, criterion_group, criterion_main};
use perception::boxes::anchors::Anchors;
use perception::boxes::decode::decode;
use perception::boxes::nms::rotated_nms;
use perception::model_config::DetectorConfig;
use protocol::Box3d;
use protocol::rotated_iou::Polygon;
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;

/// `count` boxes around `vehicles` positions, like the output of a head: many near-copies of each vehicle.
fn boxes(count: usize, vehicles: usize, seed: u64) -> (Vec<Polygon>, Vec<f32>) {
    let mut random = ChaCha8Rng::seed_from_u64(seed);
    let places: Vec<[f64; 3]> = (0..vehicles)
        .map(|_| {
            [
                random.random_range(-100.0..100.0),
                random.random_range(-40.0..40.0),
                random.random_range(-3.1..3.1),
            ]
        })
        .collect();
    (0..count)
        .map(|index| {
            let [x, y, heading] = places[index % vehicles];
            let mut near = |spread: f64| random.random_range(-spread..spread);
            let box3d = Box3d {
                center_m: [x + near(1.0), y + near(1.0), -1.0],
                size_m: [4.2 + near(0.5), 1.8 + near(0.2), 1.6],
                heading_rad: heading + near(0.2),
            };
            (Polygon::footprint(&box3d.corners()), random.random::<f32>())
        })
        .unzip()
}

fn nms(criterion: &mut Criterion) {
    // All apart is the worst case: every box is compared with every better one.
    for (name, vehicles) in [("clusters", 40), ("apart", 1000)] {
        let (polygons, scores) = boxes(1000, vehicles, 1000);
        let kept = rotated_nms(&polygons, &scores, 0.15, 1000);
        assert!(
            kept.len() >= vehicles.min(40) && kept.len() < 1000,
            "{}",
            kept.len()
        );
        criterion.bench_function(&format!("nms/{name}/1000"), |bencher| {
            bencher.iter(|| rotated_nms(black_box(&polygons), black_box(&scores), 0.15, 1000));
        });
    }
}

fn decoding(criterion: &mut Criterion) {
    let anchors = Anchors::for_detector(&DetectorConfig::lean());
    let scores: Vec<f32> = (0..anchors.len())
        .map(|index| if index % 100 == 0 { 1.0 } else { -4.0 })
        .collect();
    let offsets = vec![0.1; anchors.len() * 7];
    assert_eq!(
        decode(&scores, &offsets, &anchors, 0.2)
            .expect("sizes fit")
            .len(),
        anchors.len().div_ceil(100)
    );
    criterion.bench_function("decode/lean/246", |bencher| {
        bencher.iter(|| decode(black_box(&scores), black_box(&offsets), &anchors, 0.2));
    });
}

criterion_group!(benches, nms, decoding);
criterion_main!(benches);
