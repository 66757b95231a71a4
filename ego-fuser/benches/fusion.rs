//! Warping and fusing maps of `lean`, per method and number of vehicles.
//!
//! `cargo bench -p ego-fuser --bench fusion -- attention/3`

use std::hint::black_box;

use agent::model_config::DetectorConfig;
use criterion::{BenchmarkId, Criterion, criterion_group, criterion_main};
use ego_fuser::Method;
use ego_fuser::fusion::{self, AlignedViews};
use ego_fuser::warp::warp_to_ego;
use protocol::Pose;
use tch::{Device, Kind, Tensor};

fn fuse(criterion: &mut Criterion) {
    tch::set_num_threads(1);
    let config = DetectorConfig::lean();
    let grid = config.feature_grid();
    let shape = [config.feature_channels(), i64::from(grid.height), i64::from(grid.width)];
    let mut group = criterion.benchmark_group("warp_and_fuse/lean");
    for agents in [1usize, 2, 3, 5] {
        let features = Tensor::rand([agents as i64, shape[0], shape[1], shape[2]], (Kind::Float, Device::Cpu));
        let pose = |agent: usize| Pose::from_xyz_yaw([7.0 * agent as f64, 2.0, 0.0], 0.2 * agent as f64);
        let poses: Vec<Pose> = (0..agents).map(pose).collect();
        let (confidence, age_secs) = (vec![1.0; agents], vec![0.0; agents]);
        for method in [Method::Max, Method::Attention] {
            let fusion = fusion::build(method);
            group.bench_function(BenchmarkId::new(method.name(), agents), |bencher| {
                bencher.iter(|| {
                    let warped = warp_to_ego(&features, None, &poses, &grid).expect("maps lie on the lattice");
                    let views = AlignedViews {
                        features: &warped.features,
                        mask: &warped.mask,
                        confidence: &confidence,
                        age_secs: &age_secs,
                    };
                    let fused = fusion.fuse(&views).expect("views fit together");
                    assert_eq!(fused.size(), shape);
                    black_box(fused)
                });
            });
        }
    }
    group.finish();
}

criterion_group!(benches, fuse);
criterion_main!(benches);
