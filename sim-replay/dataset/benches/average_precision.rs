//! AP of 50 frames at three thresholds in both orderings.
//!
//! `cargo bench -p dataset --bench average_precision`

use std::hint::black_box;

use criterion::{Criterion, criterion_group, criterion_main};
use dataset::average_precision::{Ordering, Scorer};
use dataset::ground_truth::GroundTruth;
use protocol::{Box3d, Detection};
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;

/// 25 objects and 40 detections, 20 of them on objects: a crowded frame.
fn frame(rng: &mut impl Rng) -> (Vec<Detection>, GroundTruth) {
    let objects: Vec<Box3d> = (0..25)
        .map(|_| Box3d {
            center_m: [
                rng.random_range(-50.0..50.0),
                rng.random_range(-38.0..38.0),
                -1.0,
            ],
            size_m: [4.5, 1.9, 1.6],
            heading_rad: rng.random_range(-3.0..3.0),
        })
        .collect();
    let detections = (0..40)
        .map(|index| {
            let mut box3d = objects[index % objects.len()];
            let spread = if index < 20 { 0.5 } else { 20.0 };
            box3d.center_m[0] += rng.random_range(-spread..spread);
            Detection {
                box3d,
                score: rng.random(),
                source: None,
            }
        })
        .collect();
    (detections, GroundTruth::of_boxes(objects))
}

fn average_precision(criterion: &mut Criterion) {
    let mut rng = ChaCha8Rng::seed_from_u64(1);
    let frames: Vec<_> = (0..50).map(|_| frame(&mut rng)).collect();
    criterion.bench_function("average_precision/50_frames/40x25", |bencher| {
        bencher.iter(|| {
            let mut scorer = Scorer::default();
            for (detections, truth) in &frames {
                scorer.add(detections, truth);
            }
            let found = [Ordering::Global, Ordering::Frame]
                .map(|ordering| scorer.average_precisions(ordering));
            assert!(
                found
                    .iter()
                    .flatten()
                    .flatten()
                    .all(|ap| (0.0..=1.0).contains(ap))
            );
            black_box(found)
        });
    });
}

criterion_group!(benches, average_precision);
criterion_main!(benches);
