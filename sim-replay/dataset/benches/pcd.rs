//! Reading sweeps: `decode/<encoding>/<points>`.
//!
//! One case alone: `cargo bench -p dataset --bench pcd -- decode/ascii`.

use std::hint::black_box;

use criterion::{BenchmarkId, Criterion, Throughput, criterion_group, criterion_main};
use dataset::pcd::{self, Encoding, IntensityField};
use protocol::PointCloud;

/// A sweep of the size of OPV2V's: rings of points, with the intensity that distance gives them.
fn sweep(points: usize) -> PointCloud {
    let point = |index: usize| {
        let (angle, range) = (index as f32 * 0.013, 3.0 + (index % 1000) as f32 * 0.117);
        [
            range * angle.cos(),
            range * angle.sin(),
            -1.9 + (index % 64) as f32 * 0.07,
            (-0.004 * range).exp(),
        ]
    };
    PointCloud {
        xyzi: (0..points).map(point).collect(),
    }
}

fn decode(c: &mut Criterion) {
    let mut group = c.benchmark_group("decode");
    let cloud = sweep(40_000);
    for (name, encoding, intensity) in [
        ("ascii", Encoding::Ascii, IntensityField::Red),
        ("binary", Encoding::Binary, IntensityField::Intensity),
    ] {
        let file = pcd::encode(&cloud, encoding, intensity);
        assert_eq!(
            pcd::decode(&file).map(|read| read.points.len()),
            Ok(cloud.len())
        );
        group.throughput(Throughput::Bytes(file.len() as u64));
        group.bench_with_input(BenchmarkId::new(name, cloud.len()), &file, |b, file| {
            b.iter(|| pcd::decode(black_box(file)));
        });
    }
    group.finish();
}

criterion_group!(benches, decode);
criterion_main!(benches);
