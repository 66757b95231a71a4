//! Warping and fusing maps of `lean`, per method and number of vehicles.
//!
//! `cargo bench -p ego-fuser --bench fusion -- attention/3`

use std::hint::black_box;

use agent::model_config::DetectorConfig;
use criterion::{BenchmarkId, Criterion, criterion_group, criterion_main};
use ego_fuser::fusion::{FusionStage, ViewFacts};
use ego_fuser::{Exchange, Method};
use protocol::Pose;
use tch::{Device, Kind, Tensor, no_grad};

fn fuse(criterion: &mut Criterion) {
    tch::set_num_threads(1);
    let config = DetectorConfig::lean();
    let grid = config.feature_grid();
    let shape = [config.feature_channels(), i64::from(grid.height), i64::from(grid.width)];
    let mut group = criterion.benchmark_group("warp_and_fuse/lean");
    for agents in [1usize, 2, 3, 5] {
        let features = Tensor::rand([agents as i64, shape[0], shape[1], shape[2]], (Kind::Float, Device::Cpu));
        let pose = |agent: usize| Pose::from_xyz_yaw([7.0 * agent as f64, 2.0, 0.0], 0.2 * agent as f64);
        let facts: Vec<_> = (0..agents).map(|agent| ViewFacts::fresh(agent, pose(agent))).collect();
        for method in Method::ALL.into_iter().filter(|method| method.exchange() == Exchange::Features) {
            let stage = FusionStage::untrained(method, &config).expect("lean is a valid configuration");
            group.bench_function(BenchmarkId::new(method.name(), agents), |bencher| {
                bencher.iter(|| {
                    let maps = stage.align(&features, None, &facts).expect("maps lie on the lattice");
                    let fused = no_grad(|| stage.fuse(&maps, &facts, false)).expect("views fit together");
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
