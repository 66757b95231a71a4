//! The detector against the reference implementation: encoder and voxelisation.

use perception::layers::agent_attention::attend_ego;
use perception::layers::backbone::BevBackbone;
use perception::layers::head::DetectionHead;
use perception::layers::shrink::{Compressor, Shrink};
use perception::model_config::{DetectorConfig, ShrinkConfig};
use perception::pillars::batch::{PillarBatch, PillarGrid};
use perception::pillars::encoder::PillarEncoder;
use perception::pillars::projection::PillarProjection;
use perception::pillars::voxels::{Pillars, Voxeliser};
use tch::nn::VarStore;
use tch::{Device, Tensor};
use tests::fixtures::{Golden, assert_close, golden};
use tests::tensors::{array, integer, integers, load, pillars, tensor, values};

/// Tolerances of the encoder cases.
const ATOL: f64 = 2e-4;
const RTOL: f64 = 1e-4;

#[test]
fn golden_c1_pointpillar() {
    let golden = golden("c1_pointpillar");
    let case = EncoderCase::new(&golden);
    let (_, expected) = golden.f32("out.pillar_features");
    let pillar_features = tch::no_grad(|| case.encoder.forward(&case.batch, false));
    let rows = case
        .row_of_pillar
        .iter()
        .map(|&row| row as i64)
        .collect::<Vec<_>>();
    let in_file_order = pillar_features.index_select(0, &Tensor::from_slice(&rows));
    assert_close(
        "pillar_features",
        &values(&in_file_order),
        &expected,
        ATOL,
        RTOL,
    );

    let canvas = case.batch.scatter(&pillar_features, &case.pillar_grid);
    let (_, expected) = golden.f32("out.spatial_features_ch0_7");
    assert_close(
        "spatial_features",
        &values(&canvas.narrow(1, 0, 8)),
        &expected,
        ATOL,
        RTOL,
    );

    // The detector's own pillar encoder works without tensors, sweep by sweep.
    let projection = PillarProjection::new(&case.encoder);
    let size = case.pillar_grid.width * case.pillar_grid.height * projection.channels;
    let mut canvases = vec![0.0; case.sweeps.len() * size];
    for (pillars, canvas) in case.sweeps.iter().zip(canvases.chunks_exact_mut(size)) {
        projection.scatter(pillars, &case.pillar_grid, canvas);
    }
    let projected = Tensor::from_slice(&canvases)
        .reshape(canvas.permute([0, 2, 3, 1]).size())
        .permute([0, 3, 1, 2]);
    assert_close(
        "projected",
        &values(&projected.narrow(1, 0, 8)),
        &expected,
        ATOL,
        RTOL,
    );

    for backbone in [None, Some(case.backbone.folded())] {
        let backbone = backbone.as_ref().unwrap_or(&case.backbone);
        case.check_from_2d(&golden, &tch::no_grad(|| backbone.forward(&canvas, false)));
    }
}

#[test]
fn golden_c1_intermediate_attfuse() {
    let golden = golden("c1_intermediate_attfuse");
    let case = EncoderCase::new(&golden);
    let (_, record_len) = golden.i64("in.record_len");
    let canvas = case.batch.scatter(
        &tch::no_grad(|| case.encoder.forward(&case.batch, false)),
        &case.pillar_grid,
    );
    for backbone in [None, Some(case.backbone.folded())] {
        let backbone = backbone.as_ref().unwrap_or(&case.backbone);
        // After every level the agents of a sample are fused; each agent's own features continue to the next level.
        let attend = |level: Tensor| {
            let samples = level.split_with_sizes(&record_len, 0);
            let fused = samples.iter().map(|maps| attend_ego(maps, None).unwrap());
            Tensor::stack(&fused.collect::<Vec<_>>(), 0)
        };
        let features = tch::no_grad(|| {
            let levels = backbone.levels_of(&canvas, false).into_iter();
            backbone.upsampled(&levels.map(attend).collect::<Vec<_>>(), false)
        });
        case.check_from_2d(&golden, &features);
    }
}

#[test]
fn golden_c1_shrink_compress() {
    let golden = golden("c1_shrink_compress");
    let config = golden.config();
    let (input, channels) = (integer(&config["input_dim"]), integer(&config["dim"][0]));
    let shrink_config = ShrinkConfig::DoubleConv {
        channels,
        stride: integer(&config["stride"][0]),
    };
    let network = VarStore::new(Device::Cpu);
    let shrink = Shrink::new(&(network.root() / "shrink"), input, &shrink_config);
    let compressor = Compressor::new(
        &(network.root() / "compress"),
        channels,
        integer(&config["compress_ratio"]),
    );
    load(&network, &golden, "");
    let x = tensor(&golden, "in.x");
    for (shrink, compressor) in [
        (&shrink, &compressor),
        (&shrink.folded(), &compressor.folded()),
    ] {
        let (reduced, code, decoded) = tch::no_grad(|| {
            let reduced = shrink.forward(&x, false);
            let code = compressor.encode(&reduced, false);
            let decoded = compressor.decode(&code, false);
            (reduced, code, decoded)
        });
        for (name, actual) in [
            ("out.shrink", reduced),
            ("out.code", code),
            ("out.decoded", decoded),
        ] {
            let (shape, expected) = golden.f32(name);
            assert_eq!(
                actual.size(),
                shape.iter().map(|&size| size as i64).collect::<Vec<_>>(),
                "{name}"
            );
            assert_close(name, &values(&actual), &expected, ATOL, RTOL);
        }
    }
}

#[test]
fn golden_c2_voxelise() {
    let golden = golden("c2_voxelise");
    let config = golden
        .config()
        .as_object()
        .expect("one configuration per cloud");
    assert!(!config.is_empty());
    for (name, config) in config {
        let grid: [usize; 3] = array(&config["grid"]).map(|count| count as usize);
        let caps = [&config["max_points_per_voxel"], &config["max_voxels"]]
            .map(|cap| integer(cap) as usize);
        let config = DetectorConfig {
            lidar_range_m: array(&config["lidar_range"]),
            voxel_size_m: array(&config["voxel_size"]),
            max_points_per_pillar: caps[0],
            max_pillars: caps[1],
            ..DetectorConfig::full()
        };
        assert_eq!(config.pillar_grid(), grid, "{name}");
        let mut voxeliser = Voxeliser::for_detector(&config);
        let (_, points) = golden.f32(&format!("{name}.in.points"));
        let points: Vec<[f32; 4]> = points.as_chunks().0.to_vec();
        let pillars = voxeliser.voxelise(&points);
        let (_, coords) = golden.i32(&format!("{name}.out.voxel_coords"));
        assert_eq!(pillars.coords.as_flattened(), coords, "{name}: coordinates");
        let (_, counts) = golden.i32(&format!("{name}.out.voxel_num_points"));
        assert!(
            pillars
                .counts
                .iter()
                .zip(&counts)
                .all(|(&a, &b)| i64::from(a) == i64::from(b)),
            "{name}: counts"
        );
        let (_, features) = golden.f32(&format!("{name}.out.voxel_features_packed"));
        assert_eq!(pillars.points.as_flattened(), features, "{name}: points");
    }
}

/// A whole encoder with the weights of a case, and its input.
struct EncoderCase {
    pillar_grid: PillarGrid,
    sweeps: Vec<Pillars>,
    batch: PillarBatch,
    /// Row of the batch for every pillar in the order of the file.
    row_of_pillar: Vec<usize>,
    encoder: PillarEncoder,
    backbone: BevBackbone,
    head: DetectionHead,
}

impl EncoderCase {
    fn new(golden: &Golden) -> Self {
        tch::set_num_threads(1);
        let config = encoder_config(golden);
        let network = VarStore::new(Device::Cpu);
        let root = network.root();
        let encoder = PillarEncoder::new(&(&root / "pillar_vfe"), config.pillar_channels);
        let backbone = BevBackbone::new(&(&root / "backbone"), &config);
        let anchors = golden.f32("w.cls_head.bias").1.len() as i64;
        let head = DetectionHead::new(&root, config.backbone_channels(), anchors);
        load(&network, golden, "");
        let pillar_grid = PillarGrid::new(&config);
        let (sweeps, row_of_pillar) = pillars(golden);
        let batch = PillarBatch::new(&sweeps.iter().collect::<Vec<_>>(), &pillar_grid);
        Self {
            pillar_grid,
            sweeps,
            batch,
            row_of_pillar,
            encoder,
            backbone,
            head,
        }
    }

    /// Compares the concatenated levels and the heads.
    fn check_from_2d(&self, golden: &Golden, features: &Tensor) {
        let every_8th: Vec<i64> = (0..features.size()[1]).step_by(8).collect();
        let (_, expected) = golden.f32("out.spatial_features_2d_ch_every_8th");
        let part = features.index_select(1, &Tensor::from_slice(&every_8th));
        assert_close("spatial_features_2d", &values(&part), &expected, ATOL, RTOL);
        let heads = tch::no_grad(|| self.head.forward(features)).unwrap();
        assert_close(
            "psm",
            &values(&heads.scores),
            &golden.f32("out.psm").1,
            ATOL,
            RTOL,
        );
        assert_close(
            "rm",
            &values(&heads.offsets),
            &golden.f32("out.rm").1,
            ATOL,
            RTOL,
        );
    }
}

/// The sizes of the network, from the configuration and the shapes of the weights.
fn encoder_config(golden: &Golden) -> DetectorConfig {
    let config = golden.config();
    let layer_nums: Vec<usize> = integers(&config["layer_nums"])
        .iter()
        .map(|&count| count as usize)
        .collect();
    let levels = layer_nums.len();
    let deblock = |level: usize| {
        golden
            .f32(&format!("w.backbone.deblocks.{level}.0.weight"))
            .0
    };
    DetectorConfig {
        name: "golden".into(),
        lidar_range_m: array(&config["lidar_range"]),
        voxel_size_m: array(&config["voxel_size"]),
        max_points_per_pillar: integer(&config["max_points"]) as usize,
        pillar_channels: golden.f32("w.pillar_vfe.pfn_layers.0.linear.weight").0[0] as i64,
        layer_nums,
        layer_strides: vec![2; levels],
        num_filters: integers(&config["num_filters"]),
        upsample_strides: (0..levels).map(|level| deblock(level)[2] as i64).collect(),
        num_upsample_filters: (0..levels).map(|level| deblock(level)[1] as i64).collect(),
        shrink: None,
        ..DetectorConfig::full()
    }
}
