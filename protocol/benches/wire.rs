//! Encoding and decoding of messages: `stage/codec/size`, sizes in KiB of the feature map as `f32`.
//!
//! One case: `cargo bench -p protocol -- decode/f32/8192`. Every case checks once that decoding restores the input.

use std::hint::black_box;

use criterion::{BatchSize, BenchmarkId, Criterion, Throughput, criterion_group, criterion_main};
use protocol::{
    Bev, BevFeatures, BevGrid, CavId, CodecConfig, Dtype, Limits, Pose, PoseEstimate, Stamp,
    encode_features, wire,
};

/// Approximate size of the pieces of a zenoh payload, bytes.
const PIECE_BYTES: usize = 49_152;

/// 64 channels on a grid that makes `kib` KiB of `f32`; half of the values are zero, as after a ReLU.
fn features(kib: usize) -> BevFeatures {
    let (channels, cells) = (64, kib * 1024 / 4 / 64);
    let grid = BevGrid {
        x_min_m: -51.2,
        y_min_m: -38.4,
        cell_m: 0.8,
        width: 16,
        height: cells as u32 / 16,
    };
    let mut state = 1u32;
    let values = std::iter::repeat_with(|| {
        state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
        ((state >> 8) as f32 / 8_388_608.0 - 1.0).max(0.0)
    });
    BevFeatures {
        grid,
        channels,
        code_of: None,
        values: values.take(64 * cells).collect(),
    }
}

fn confidence(cells: usize) -> Vec<f32> {
    (0..cells)
        .map(|cell| (cell * 7919 % 9973) as f32 / 9973.0)
        .collect()
}

fn stamp() -> Stamp {
    let cav = CavId::new("4279").expect("an identifier");
    Stamp {
        cav,
        epoch: 1,
        sequence: 2,
        capture_nanos: 3,
        publish_nanos: 4,
    }
}

/// Name and configuration of every codec; a budget is a quarter of the feature map in that dtype.
fn codecs(kib: usize) -> Vec<(&'static str, CodecConfig)> {
    let quarter = Some(kib as u64 * 1024 / 4);
    let codec = |dtype, budget_bytes, zstd_level| CodecConfig {
        dtype,
        budget_bytes,
        zstd_level,
        gate: None,
    };
    vec![
        ("f32", codec(Dtype::F32, None, None)),
        ("f16", codec(Dtype::F16, None, None)),
        ("i8", codec(Dtype::I8, None, None)),
        ("f32-topk", codec(Dtype::F32, quarter, None)),
        (
            "f16-topk",
            codec(Dtype::F16, quarter.map(|bytes| bytes / 2), None),
        ),
        (
            "i8-topk",
            codec(Dtype::I8, quarter.map(|bytes| bytes / 4), None),
        ),
        ("f16-zstd", codec(Dtype::F16, None, Some(1))),
        ("i8-zstd", codec(Dtype::I8, None, Some(1))),
    ]
}

fn message(features: BevFeatures, config: &CodecConfig, confidence: &[f32]) -> Bev {
    let pose = PoseEstimate::new(Pose::IDENTITY, 0.5);
    Bev {
        pose,
        features: encode_features(features, config, Some(confidence)).expect("a valid map"),
    }
}

fn bench(criterion: &mut Criterion) {
    let stamp = stamp();
    for kib in [64, 1024, 8192] {
        let features = features(kib);
        let confidence = confidence(features.grid.cells());
        for (name, config) in codecs(kib) {
            let encoded = wire::encode(&stamp, message(features.clone(), &config, &confidence))
                .expect("a valid message");
            let bytes = encoded.to_vec();
            let decode = || {
                let (_, bev) = wire::decode::<Bev>(bytes.chunks(PIECE_BYTES), &Limits::DEFAULT)
                    .expect("the encoded message");
                bev.features
                    .decode(&Limits::DEFAULT)
                    .expect("the encoded map")
            };
            let back = decode();
            assert_eq!(back.features.values.len(), features.values.len());
            if config == CodecConfig::default() {
                assert_eq!(back.features, features);
            }

            let mut group = criterion.benchmark_group("encode");
            group.throughput(Throughput::Bytes(kib as u64 * 1024));
            group.bench_function(BenchmarkId::new(name, kib), |bencher| {
                let input = || features.clone();
                let encode =
                    |features| wire::encode(&stamp, message(features, &config, &confidence));
                bencher.iter_batched(input, encode, BatchSize::PerIteration);
            });
            group.finish();

            let mut group = criterion.benchmark_group("decode");
            group.throughput(Throughput::Bytes(kib as u64 * 1024));
            group.bench_function(BenchmarkId::new(name, kib), |bencher| {
                bencher.iter_batched(|| (), |()| black_box(decode()), BatchSize::PerIteration);
            });
            group.finish();
        }
    }
}

criterion_group! {
    name = benches;
    config = Criterion::default().sample_size(20).warm_up_time(std::time::Duration::from_millis(300)).measurement_time(std::time::Duration::from_secs(1));
    targets = bench
}
criterion_main!(benches);
