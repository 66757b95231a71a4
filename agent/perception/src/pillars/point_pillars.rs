//! PointPillars network, for training and for inference.

use tch::{Device, Kind, TchError, Tensor, nn};

use crate::layers::backbone::BevBackbone;
use crate::layers::head::{DetectionHead, HeadOutput};
use crate::layers::shrink::{Compressor, Shrink};
use crate::model_config::{ConfigError, DetectorConfig};
use crate::pillars::batch::{PillarBatch, PillarGrid};
use crate::pillars::encoder::PillarEncoder;

/// The detector's network. Parameter names are those of the reference's state dictionary.
#[derive(Debug)]
pub struct PointPillars {
    /// Configuration that it was built from.
    pub config: DetectorConfig,
    /// Grid of the pillars on the canvas.
    pub pillar_grid: PillarGrid,
    /// Precision of the convolutions in training: `Float`, or `BFloat16` if the CPU computes it several times as fast.
    /// Parameters, norms, pillar features and heads are `f32` in any case.
    pub compute: Kind,
    /// `pillar_vfe`: points to pillar features.
    pub encoder: PillarEncoder,
    /// `backbone`: the 2D convolutions.
    pub backbone: BevBackbone,
    /// `shrink_conv`: the last step before transmission; without layers where there is none.
    pub shrink: Shrink,
    /// `naive_compressor`: fewer transmitted channels.
    pub compressor: Option<Compressor>,
    /// `cls_head` and `reg_head`.
    pub head: DetectionHead,
}

impl PointPillars {
    /// Builds the network under `path` with random parameters (`tch::manual_seed` makes them reproducible).
    ///
    /// # Errors
    /// [`ConfigError`] when no network can be built from `config`.
    pub fn new(path: &nn::Path<'_>, config: &DetectorConfig) -> Result<Self, ConfigError> {
        // Before anything is allocated: the numbers may come from any file.
        config.validate()?;
        let (wide, channels) = (config.backbone_channels(), config.feature_channels());
        Ok(Self {
            pillar_grid: PillarGrid::new(config),
            compute: Kind::Float,
            encoder: PillarEncoder::new(&(path / "pillar_vfe"), config.pillar_channels),
            backbone: BevBackbone::new(&(path / "backbone"), config),
            shrink: (config.shrink.as_ref())
                .map(|shrink| Shrink::new(&(path / "shrink_conv"), wide, shrink))
                .unwrap_or_default(),
            compressor: (config.compress_ratio)
                .map(|ratio| Compressor::new(&(path / "naive_compressor"), channels, ratio)),
            head: DetectionHead::new(path, channels, config.anchors.yaws_deg.len() as i64),
            config: config.clone(),
        })
    }

    /// Device of its parameters.
    pub fn device(&self) -> Device {
        self.encoder.linear.device()
    }

    /// Feature map of every sweep: `[B, C, H, W]`, before the compressor.
    pub fn features(&self, batch: &PillarBatch, train: bool) -> Tensor {
        let canvas = batch.scatter(&self.encoder.forward(batch, train), &self.pillar_grid);
        self.features_of_canvas(&canvas, train)
    }

    /// Feature maps of the canvas `[B, C_pillar, H, W]`: backbone and shrink, `f32`.
    pub fn features_of_canvas(&self, canvas: &Tensor, train: bool) -> Tensor {
        let wide = self.backbone.forward(&canvas.to_kind(self.compute), train);
        self.shrink.forward(&wide, train).to_kind(Kind::Float)
    }

    /// Output of the compressor: `[B, C, H, W]` compressed and expanded again; unchanged without a compressor.
    pub fn through_compressor(&self, features: &Tensor, train: bool) -> Tensor {
        match &self.compressor {
            Some(compressor) => compressor.decode(&compressor.encode(features, train), train),
            None => features.shallow_clone(),
        }
    }

    /// Scores and offsets of `[B, C, H, W]` features, of one agent or fused.
    ///
    /// # Errors
    /// Those of the tensor library, when the features have another number of channels than the head.
    pub fn heads(&self, features: &Tensor) -> Result<HeadOutput, TchError> {
        self.head.forward(features)
    }
}

#[cfg(test)]
mod tests {
    use tch::Device;
    use tch::nn::{OptimizerConfig, VarStore};

    use super::*;
    use crate::pillars::voxels::Voxeliser;

    fn small() -> DetectorConfig {
        DetectorConfig {
            lidar_range_m: [-6.4, -6.4, -3.0, 6.4, 6.4, 1.0],
            ..DetectorConfig::lean()
        }
    }

    fn batch(config: &DetectorConfig) -> PillarBatch {
        let points: Vec<[f32; 4]> = (0..500)
            .map(|k| {
                [
                    k as f32 * 0.02 - 5.0,
                    (k % 50) as f32 * 0.2 - 5.0,
                    -1.0,
                    0.5,
                ]
            })
            .collect();
        let pillars = Voxeliser::for_detector(config).voxelise(&points);
        PillarBatch::new(&[&pillars, &pillars], &PillarGrid::new(config))
    }

    /// Loss before and after a few steps towards an arbitrary target.
    fn train(compute: Kind, start: &VarStore) -> (f64, f64) {
        tch::set_num_threads(1);
        let mut network = VarStore::new(Device::Cpu);
        let mut pillars = PointPillars::new(&network.root(), &small()).unwrap();
        network.copy(start).unwrap();
        pillars.compute = compute;
        let batch = batch(&small());
        let mut optimizer = tch::nn::Adam::default().build(&network, 1e-2).unwrap();
        let mut losses = Vec::new();
        for _ in 0..20 {
            let heads = pillars.heads(&pillars.features(&batch, true)).unwrap();
            let loss = (heads.scores - 1.0).square().mean(Kind::Float)
                + heads.offsets.square().mean(Kind::Float);
            optimizer.backward_step(&loss);
            losses.push(loss.double_value(&[]));
        }
        let running = network.variables()["backbone.blocks.0.2.running_mean"]
            .abs()
            .sum(Kind::Float);
        assert!(
            running.double_value(&[]) > 0.0,
            "training moves the running statistics"
        );
        (losses[0], losses[losses.len() - 1])
    }

    #[test]
    fn it_learns_in_both_precisions() {
        // Both from the same values: tests that run at the same time share torch's generator.
        let start = VarStore::new(Device::Cpu);
        PointPillars::new(&start.root(), &small()).unwrap();
        let (first, last) = train(Kind::Float, &start);
        assert!(last < 0.5 * first, "{first} {last}");
        let (first_half, last_half) = train(Kind::BFloat16, &start);
        assert!(
            (first_half - first).abs() < 0.02 * first && (last_half - last).abs() < 0.2 * first,
            "{first_half} {last_half}"
        );
    }

    #[test]
    fn maps_have_the_documented_shape_and_heads_reject_others() {
        tch::set_num_threads(1);
        let network = VarStore::new(Device::Cpu);
        let config = small();
        let pillars = PointPillars::new(&network.root(), &config).unwrap();
        let features = tch::no_grad(|| pillars.features(&batch(&config), false));
        let grid = config.feature_grid();
        assert_eq!(
            features.size(),
            [
                2,
                config.feature_channels(),
                i64::from(grid.height),
                i64::from(grid.width)
            ]
        );
        let heads = pillars.heads(&features).unwrap();
        assert_eq!(heads.offsets.size()[1], 14);
        assert_eq!(
            heads.confidence().size(),
            [2, i64::from(grid.height), i64::from(grid.width)]
        );
        assert!(pillars.heads(&features.narrow(1, 0, 8)).is_err());
    }
}
