//! Alignment by boxes: graph matching of two vehicles with 22 boxes each, 12 of them in common.
//!
//! `cargo bench -p ego-fuser --bench alignment`

use std::hint::black_box;

use criterion::{Criterion, criterion_group, criterion_main};
use ego_fuser_offline::alignment::free_align::MIN_MATCHES;
use ego_fuser_offline::alignment::{align_boxes, box_icp};
use nalgebra::{Isometry3, Vector3};
use protocol::Box3d;
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;

fn alignment(criterion: &mut Criterion) {
    let mut random = ChaCha8Rng::seed_from_u64(1);
    let mut boxes = |count: usize| -> Vec<Box3d> {
        let mut car = || Box3d {
            center_m: [
                random.random_range(-60.0..60.0),
                random.random_range(-40.0..40.0),
                -1.0,
            ],
            size_m: [4.5, 1.9, 1.6],
            heading_rad: random.random_range(-3.0..3.0),
        };
        (0..count).map(|_| car()).collect()
    };
    let common = boxes(12);
    let truth = Isometry3::new(Vector3::new(22.0, -7.0, 0.2), Vector3::z() * 2.5);
    let moved = common.iter().map(|node| node.transformed(&truth.inverse()));
    let neighbour: Vec<_> = moved.chain(boxes(10)).collect();
    let ego: Vec<_> = common.iter().copied().chain(boxes(10)).collect();
    let found = align_boxes(&ego, &neighbour, MIN_MATCHES).expect("12 boxes in common");
    assert!(
        truth
            .inv_mul(&found.ego_from_neighbour)
            .translation
            .vector
            .norm()
            < 0.5
    );
    criterion.bench_function("alignment/free_align/22x22", |bencher| {
        bencher.iter(|| align_boxes(black_box(&ego), black_box(&neighbour), MIN_MATCHES));
    });
    criterion.bench_function("alignment/box_icp/22x22", |bencher| {
        bencher.iter(|| {
            box_icp::align(
                black_box(&ego),
                black_box(&neighbour),
                &Isometry3::identity(),
            )
        });
    });
}

criterion_group!(benches, alignment);
criterion_main!(benches);
