//! PointPillars as one network, for training and for inference.

use tch::{Kind, TchError, Tensor, nn};

use crate::backbone::BevBackbone;
use crate::head::{DetectionHead, HeadOutput};
use crate::model_config::{ConfigError, DetectorConfig};
use crate::pillar_batch::{PillarBatch, PillarLattice};
use crate::pillar_encoder::PillarEncoder;
use crate::shrink::{Compressor, Shrink};

/// The detector's network. Parameter names are those of the reference's state dictionary.
#[derive(Debug)]
pub struct PointPillars {
    /// The numbers it was built from.
    pub config: DetectorConfig,
    lattice: PillarLattice,
    /// Precision of the convolutions in training: `Float`, or `BFloat16` where the processor computes it several times
    /// as fast. Parameters, norms, pillar features and heads are `f32` in any case.
    pub compute: Kind,
    /// `pillar_vfe`: points to pillar features.
    pub encoder: PillarEncoder,
    /// `backbone`: the 2D convolutions.
    pub backbone: BevBackbone,
    /// `shrink_conv`: the last step before the air.
    pub shrink: Option<Shrink>,
    /// `naive_compressor`: fewer channels on the air.
    pub compressor: Option<Compressor>,
    /// `cls_head` and `reg_head`.
    pub head: DetectionHead,
}

impl PointPillars {
    /// Builds the network under `path` with random parameters (`tch::manual_seed` makes them repeatable).
    ///
    /// # Errors
    /// [`ConfigError`] when no network can be built from `config`.
    pub fn new(path: &nn::Path<'_>, config: &DetectorConfig) -> Result<Self, ConfigError> {
        config.validate()?;
        let channels = config.feature_channels();
        Ok(Self {
            lattice: PillarLattice::new(config),
            compute: Kind::Float,
            encoder: PillarEncoder::new(&(path / "pillar_vfe"), config.pillar_channels),
            backbone: BevBackbone::new(&(path / "backbone"), config),
            shrink: (config.shrink.as_ref())
                .map(|shrink| Shrink::new(&(path / "shrink_conv"), config.backbone_channels(), shrink)),
            compressor: (config.compress_ratio)
                .map(|ratio| Compressor::new(&(path / "naive_compressor"), channels, ratio)),
            head: DetectionHead::new(path, channels, config.anchors.yaws_deg.len() as i64),
            config: config.clone(),
        })
    }

    /// Where pillars stand on the canvas.
    #[must_use]
    pub fn lattice(&self) -> &PillarLattice {
        &self.lattice
    }

    /// The map of every sweep that crosses the air: `[B, C, H, W]`, before the compressor.
    #[must_use]
    pub fn features(&self, batch: &PillarBatch, train: bool) -> Tensor {
        let canvas = batch.scatter(&self.encoder.forward(batch, train), &self.lattice);
        self.features_of_canvas(&canvas, train)
    }

    /// From the canvas `[B, C_pillar, H, W]` on: backbone and shrink, `f32`.
    #[must_use]
    pub fn features_of_canvas(&self, canvas: &Tensor, train: bool) -> Tensor {
        let wide = self.backbone.forward(&canvas.to_kind(self.compute), train);
        let features = match &self.shrink {
            Some(shrink) => shrink.forward(&wide, train),
            None => wide,
        };
        features.to_kind(Kind::Float)
    }

    /// What the compressor loses: `[B, C, H, W]` squeezed and widened again; unchanged without a compressor.
    #[must_use]
    pub fn through_compressor(&self, features: &Tensor, train: bool) -> Tensor {
        match &self.compressor {
            Some(compressor) => compressor.decode(&compressor.encode(features, train), train),
            None => features.shallow_clone(),
        }
    }

    /// Scores and offsets of `[B, C, H, W]` features, of one agent or fused.
    ///
    /// # Errors
    /// The tensor library's, when the features have another number of channels than the head.
    pub fn heads(&self, features: &Tensor) -> Result<HeadOutput, TchError> {
        self.head.forward(features)
    }
}
