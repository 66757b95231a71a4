//! Contract of every method of the table.

use perception::model_config::ShrinkConfig;
use protocol::{BevGrid, Pose};
use tch::nn::VarStore;
use tch::{Device, Kind, Tensor, no_grad};

use super::*;
use crate::model::FusionStage;
use crate::{AlignedMaps, Fusion, MapMetadata, ReceivedMaps};

const FLOAT: (Kind, Device) = (Kind::Float, Device::Cpu);
const SHAPE: [i64; 3] = [16, 16, 24];

/// The fusion of every method, untrained.
fn all() -> impl Iterator<Item = (Method, Box<dyn Fusion>)> {
    tch::set_num_threads(1);
    let shrink = Some(ShrinkConfig::Pointwise { channels: SHAPE[0] });
    let detector = DetectorConfig {
        shrink,
        ..DetectorConfig::lean()
    };
    Method::ALL.into_iter().map(move |method| {
        let variables = VarStore::new(Device::Cpu);
        (
            method,
            method
                .default_fusion(&detector)
                .build(&variables.root())
                .unwrap(),
        )
    })
}

fn random(agents: i64) -> Tensor {
    Tensor::rand([agents, SHAPE[0], SHAPE[1], SHAPE[2]], FLOAT)
}

fn fuse(fusion: &dyn Fusion, features: &Tensor, reach: &[f32]) -> Tensor {
    let agents: Vec<usize> = (0..reach.len()).collect();
    fuse_of(fusion, features, reach, &agents)
}

/// The same for maps of these agents, each at another position.
fn fuse_of(fusion: &dyn Fusion, features: &Tensor, reach: &[f32], agents: &[usize]) -> Tensor {
    let mask = Tensor::from_slice(reach)
        .view([-1, 1, 1, 1])
        .expand([-1, 1, SHAPE[1], SHAPE[2]], false);
    let facts: Vec<_> = (agents.iter())
        .map(|&agent| {
            MapMetadata::fresh(
                agent,
                Pose::from_xyz_yaw([2.0 * agent as f64, 0.0, 0.0], 0.0),
            )
        })
        .collect();
    let (height, width) = (SHAPE[1] as u32, SHAPE[2] as u32);
    let grid = BevGrid {
        x_min_m: -12.0,
        y_min_m: -8.0,
        cell_m: 1.0,
        width,
        height,
    };
    let maps = AlignedMaps::newest(features, &mask, &facts, &grid);
    let fused = no_grad(|| fusion.fuse(&maps)).unwrap().map;
    assert_eq!(fused.size(), SHAPE);
    fused
}

fn difference(one: &Tensor, other: &Tensor) -> f64 {
    (one - other).abs().max().double_value(&[])
}

#[test]
fn masked_neighbours_change_nothing() {
    let features = random(3);
    for (method, fusion) in all() {
        let ego_only = fuse(&*fusion, &features.narrow(0, 0, 1), &[1.0]);
        assert!(
            ego_only.isfinite().all().double_value(&[]) == 1.0,
            "{method}"
        );
        let masked = fuse(&*fusion, &features, &[1.0, 0.0, 0.0]);
        assert!(difference(&ego_only, &masked) < 1e-4, "{method}");
    }
}

#[test]
fn neighbours_that_are_seen_change_something_unless_maps_are_not_exchanged() {
    let features = random(3);
    for (method, fusion) in all() {
        let ego_only = fuse(&*fusion, &features.narrow(0, 0, 1), &[1.0]);
        let together = fuse(&*fusion, &features, &[1.0, 1.0, 1.0]);
        let shares_maps = method.exchange() == Exchange::Features;
        assert_eq!(
            difference(&ego_only, &together) > 1e-4,
            shares_maps,
            "{method}"
        );
    }
}

#[test]
fn the_order_of_neighbours_does_not_matter() {
    let features = random(3);
    let swapped = features.index_select(0, &Tensor::from_slice(&[0i64, 2, 1]));
    for (method, fusion) in all() {
        let one = fuse_of(&*fusion, &features, &[1.0; 3], &[0, 1, 2]);
        let other = fuse_of(&*fusion, &swapped, &[1.0; 3], &[0, 2, 1]);
        assert!(difference(&one, &other) < 1e-4, "{method}");
    }
}

#[test]
fn every_parameter_learns() {
    let features = random(3);
    let shrink = Some(ShrinkConfig::Pointwise { channels: SHAPE[0] });
    let detector = DetectorConfig {
        shrink,
        ..DetectorConfig::lean()
    };
    for method in Method::ALL {
        let variables = VarStore::new(Device::Cpu);
        let fusion = method
            .default_fusion(&detector)
            .build(&variables.root())
            .unwrap();
        let mask = Tensor::ones([3, 1, SHAPE[1], SHAPE[2]], FLOAT);
        let facts: Vec<_> = (0..3)
            .map(|agent| MapMetadata {
                age_secs: 0.07 * agent as f64,
                ..MapMetadata::fresh(agent, Pose::IDENTITY)
            })
            .collect();
        let (height, width) = (SHAPE[1] as u32, SHAPE[2] as u32);
        let grid = BevGrid {
            x_min_m: -12.0,
            y_min_m: -8.0,
            cell_m: 1.0,
            width,
            height,
        };
        let maps = AlignedMaps {
            is_training: true,
            ..AlignedMaps::newest(&features, &mask, &facts, &grid)
        };
        let fused = fusion.fuse(&maps).unwrap().map;
        if variables.is_empty() {
            continue;
        }
        (fused * random(1)).sum(Kind::Float).backward();
        for (name, variable) in variables.variables() {
            // Parameters of another agent type get no gradient from vehicles, and the temporal feature memory none from
            // the newest maps.
            let is_idle = name.contains("linears.1.")
                || name.starts_with("recall.")
                || !variable.requires_grad();
            let learns = variable.grad().defined()
                && variable.grad().isfinite().all().double_value(&[]) == 1.0;
            assert!(learns || is_idle, "{method}: {name}");
        }
    }
}

#[test]
fn names_round_trip_and_are_unique() {
    for method in Method::ALL {
        assert_eq!(method.to_string().parse(), Ok(method));
        assert_eq!(serde_json::to_value(method).unwrap(), method.name());
        assert_eq!(
            serde_json::from_value::<Method>(method.name().into()).unwrap(),
            method
        );
        assert_eq!(
            Method::ALL.iter().filter(|other| **other == method).count(),
            1,
            "{method}"
        );
    }
}

#[test]
fn the_message_lists_every_method() {
    let message = "pastat2".parse::<Method>().unwrap_err().to_string();
    assert!(
        Method::ALL
            .iter()
            .all(|method| message.contains(method.name())),
        "{message}"
    );
}

#[test]
fn settings_come_back_from_json_and_unknown_ones_are_named() {
    for method in Method::ALL {
        let config = method.default_fusion(&DetectorConfig::lean());
        let text = config.to_json();
        assert!(
            text.starts_with(&format!("{{\"kind\":\"{}\"", config.kind())),
            "{text}"
        );
        let read: FusionConfig = serde_json::from_str(&text).unwrap();
        assert!(read == config && method.has_fusion(&read), "{method}");
    }
    for (text, part) in [
        ("{\"kind\":\"mean\"}", "mean"),
        ("{\"kind\":\"max\",\"power\":2}", "power"),
        ("{}", "kind"),
    ] {
        let error = serde_json::from_str::<FusionConfig>(text).unwrap_err();
        assert!(error.to_string().contains(part), "{error}");
    }
}

/// A method as an external group would add it: settings, module and specification, and nothing elsewhere.
mod mean {
    use perception::model_config::{ConfigError, DetectorConfig};
    use serde::{Deserialize, Serialize};
    use tch::{TchError, nn};

    use crate::{
        AlignedMaps, Exchange, Fusion, FusionOutput, FusionSettings, FusionSpec, MethodSpec,
    };

    pub(super) static METHOD: MethodSpec = MethodSpec {
        name: "mean",
        summary: "feature maps, their mean",
        exchange: Exchange::Features,
        gate: None,
        runs_with_weights_of: &["max"],
        fusion: FusionSpec::of::<MeanConfig>(),
    };

    #[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
    pub(super) struct MeanConfig {
        pub(super) gain: f64,
    }

    impl FusionSettings for MeanConfig {
        const KIND: &'static str = "mean";

        fn for_detector(_detector: &DetectorConfig) -> Self {
            Self { gain: 2.0 }
        }

        fn build(&self, _path: &nn::Path<'_>) -> Result<Box<dyn Fusion>, ConfigError> {
            Ok(Box::new(Mean(self.gain)))
        }
    }

    #[derive(Debug)]
    struct Mean(f64);

    impl Fusion for Mean {
        fn fuse(&self, maps: &AlignedMaps) -> Result<FusionOutput, TchError> {
            let mean = maps
                .warped
                .features
                .f_mean_dim([0_i64].as_slice(), false, None)?;
            Ok((mean * self.0).into())
        }
    }
}

#[test]
fn a_method_from_outside_the_table_runs_through_the_pipeline() {
    let method = Method::of(&mean::METHOD);
    assert!(
        !Method::ALL.contains(&method)
            && method.name() == "mean"
            && method.weights_names() == ["max"]
    );
    let detector = DetectorConfig::lean();
    let config = method.default_fusion(&detector);
    assert_eq!(
        config
            .settings::<mean::MeanConfig>()
            .map(|settings| settings.gain),
        Some(2.0)
    );
    let stage = FusionStage::untrained(method, &detector, Device::Cpu).unwrap();
    let grid = detector.feature_grid();
    let size = [
        2,
        detector.feature_channels(),
        i64::from(grid.height),
        i64::from(grid.width),
    ];
    let maps = Tensor::rand(size, FLOAT);
    let metadata: Vec<_> = (0..2)
        .map(|agent| MapMetadata::fresh(agent, Pose::IDENTITY))
        .collect();
    let aligned = stage
        .align(&ReceivedMaps::new(maps.shallow_clone(), None), &metadata)
        .unwrap();
    let fused = stage.fuse(&aligned).unwrap();
    assert!(
        fused
            .map
            .allclose(&(maps.get(0) + maps.get(1)), 1e-6, 1e-6, false)
    );
    assert!(fused.corrections.is_none());
}
