//! Warping and fusing BEV feature maps of `lean`, per method and number of vehicles.
//!
//! `cargo bench -p ego-fuser --bench fusion -- fuse/pastat/4`: three neighbours and the ego, three time steps.

use std::hint::black_box;

use bus::malloc_settings;
use criterion::{BenchmarkId, Criterion, criterion_group, criterion_main};
use fusion::Exchange;
use fusion::Method;
use fusion::model::FusionStage;
use fusion::pastat::{Part, ablated};
use fusion::{FusionConfig, MapMetadata, ReceivedMaps};
use perception::model_config::DetectorConfig;
use protocol::{BevGrid, Pose};
use tch::nn::VarStore;
use tch::{Device, Kind, Tensor, no_grad};

/// Edge of the area of a feature map that a vehicle and its close surroundings cover, cells of 0.8 m.
const VEHICLE_CELLS: i64 = 8;

fn fuse(criterion: &mut Criterion) {
    // As in the programs.
    malloc_settings::ensure(&malloc_settings::KEPT_MEMORY)
        .expect("this program can be started again");
    tch::set_num_threads(1);
    let config = DetectorConfig::lean();
    let grid = config.feature_grid();
    let shape = [
        config.feature_channels(),
        i64::from(grid.height),
        i64::from(grid.width),
    ];
    let world = World::random(shape, &grid);
    let mut group = criterion.benchmark_group("lean");
    for agents in [1usize, 2, 4] {
        for Case {
            name,
            stage,
            is_lost,
        } in cases(&config)
        {
            // The newest of all first, in the order that the ego uses.
            let entries = (0..stage.requirements.history.frames)
                .flat_map(|step| (0..agents).map(move |agent| (step, agent)));
            let facts: Vec<_> = entries.map(|(step, agent)| entry(step, agent)).collect();
            let size = [facts.len() as i64, shape[0], shape[1], shape[2]];
            let seen = facts
                .iter()
                .enumerate()
                .map(|(index, MapMetadata { ego_from_cav, .. })| {
                    let own = (is_lost && index > 0).then(|| World::random(shape, &grid));
                    own.as_ref().unwrap_or(&world).seen_from(ego_from_cav)
                });
            let seen: Vec<Tensor> = seen.collect();
            let features = Tensor::cat(&seen, 0);
            // In the form in which the ego keeps them.
            let of =
                |first: i64, count: i64| ReceivedMaps::new(features.narrow(0, first, count), None);
            let newest = of(0, agents as i64);
            let kept: Vec<ReceivedMaps> = no_grad(|| {
                let kept = |map| stage.kept(&of(map, 1), &of(map, 1)).expect("maps are maps");
                (agents as i64..size[0]).map(kept).collect()
            });
            let align = || {
                let kept: Vec<&ReceivedMaps> = kept.iter().collect();
                let earlier = (!kept.is_empty())
                    .then(|| ReceivedMaps::together(&kept).expect("maps of one size"));
                stage
                    .align_with(&newest, earlier, &facts)
                    .expect("maps are on the grid")
            };
            group.bench_function(
                BenchmarkId::new(format!("warp/{name}"), agents),
                |bencher| {
                    bencher.iter(|| black_box(no_grad(align)));
                },
            );
            // No gradient, as in the ego: tensors with a gradient have another memory layout and take longer.
            let maps = no_grad(align);
            group.bench_function(
                BenchmarkId::new(format!("fuse/{name}"), agents),
                |bencher| {
                    bencher.iter(|| {
                        let fused = no_grad(|| stage.fuse(&maps))
                            .expect("maps fit together")
                            .map;
                        assert_eq!(fused.size(), shape);
                        black_box(fused)
                    });
                },
            );
        }
    }
    group.finish();
}

/// Surroundings of the ego. Vehicles' feature maps show the same world, so that they match at their poses.
struct World {
    /// `[1, C, H, W]`, on the ego's BEV grid.
    map: Tensor,
    /// Half the extent of the grid, metres along x and y; the ego is at its centre.
    half_m: [f64; 2],
}

impl World {
    fn random(shape: [i64; 3], grid: &BevGrid) -> Self {
        let [channels, height, width] = shape;
        // Similar over about a vehicle's length and width, so that cells worth blending are adjacent, as around
        // vehicles.
        let places = [1, channels, height / VEHICLE_CELLS, width / VEHICLE_CELLS];
        let map = Tensor::rand(places, (Kind::Float, Device::Cpu)).upsample_nearest2d(
            [height, width],
            None,
            None,
        );
        Self {
            map,
            half_m: [width, height].map(|cells| cells as f64 * grid.cell_m / 2.0),
        }
    }

    fn seen_from(&self, ego_from_cav: &Pose) -> Tensor {
        let ([x, y, _], (sin, cos)) =
            (ego_from_cav.translation_m, ego_from_cav.yaw_rad().sin_cos());
        let [half_x, half_y] = self.half_m;
        let affine = [
            cos,
            -sin * half_y / half_x,
            x / half_x,
            sin * half_x / half_y,
            cos,
            y / half_y,
        ];
        let affine = Tensor::from_slice(&affine.map(|number| number as f32)).view([1, 2, 3]);
        let places = Tensor::affine_grid_generator(&affine, self.map.size(), false);
        // Bilinear; zeros beyond.
        self.map.grid_sampler(&places, 0, 0, false)
    }
}

struct Case {
    name: String,
    stage: FusionStage,
    /// Every feature map but the ego's newest shows a different world: the worst case for FSA.
    is_lost: bool,
}

/// All methods that fuse feature maps, and their orientation-conditioned channel mixing.
fn cases(config: &DetectorConfig) -> Vec<Case> {
    let case = |name: &str, method: Method, fusion: &FusionConfig, is_lost: bool| {
        let variables = VarStore::new(Device::Cpu);
        let stage = FusionStage::new(&variables.root(), fusion, method, config)
            .expect("lean is a valid configuration");
        Case {
            name: name.to_owned(),
            stage,
            is_lost,
        }
    };
    let usual = |method: Method| method.default_fusion(config);
    let methods = Method::ALL
        .into_iter()
        .filter(|method| method.exchange() == Exchange::Features);
    let mut cases: Vec<_> = methods
        .map(|method| case(&method.to_string(), method, &usual(method), false))
        .collect();
    let pastat = usual(Method::PASTAT);
    let no_memory = ablated(&pastat, &[Part::TemporalMemory], None).expect("it is a PASTAT");
    cases.push(case("pastat-no-memory", Method::PASTAT, &no_memory, false));
    cases.push(case("pastat-lost", Method::PASTAT, &pastat, true));
    cases
}

/// Metadata of a vehicle's feature map from some time steps ago.
fn entry(step: usize, agent: usize) -> MapMetadata {
    let [step_m, agent_m] = [step, agent].map(|count| 7.0 * count as f64);
    let pose = Pose::from_xyz_yaw(
        [agent_m - 0.1 * step_m, 2.0 * agent as f64, 0.0],
        0.2 * agent as f64,
    );
    MapMetadata {
        age_secs: 0.1 * step as f64,
        ..MapMetadata::fresh(agent, pose)
    }
}

criterion_group!(benches, fuse);
criterion_main!(benches);
