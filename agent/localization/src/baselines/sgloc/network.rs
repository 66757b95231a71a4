//! Network: the encoder of the cells of a sweep, and the head that regresses their scene coordinates.

use serde::{Deserialize, Serialize};
use tch::{Kind, Tensor, nn};

use super::head::SgLocHead;
use crate::pgc::feature_norm::FeatureNorm;
use crate::pgc::{LocalizerError, SceneEncoder, SceneEncoderConfig};

/// Configuration of an SGLoc network.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SgLocConfig {
    /// Name of the scene.
    pub scene_name: String,
    /// Centre of the training positions, metres in the world.
    pub origin_m: [f64; 3],
    /// The encoder.
    pub encoder: SceneEncoderConfig,
}

/// Encoder and head of one scene.
#[derive(Debug)]
pub struct SgLoc {
    pub(super) config: SgLocConfig,
    pub(super) encoder: SceneEncoder,
    norm: FeatureNorm,
    head: SgLocHead,
}

impl SgLoc {
    /// Builds the layers below `path`.
    ///
    /// # Errors
    /// [`LocalizerError::Config`] names the field that is wrong.
    pub fn new(path: &nn::Path<'_>, config: &SgLocConfig) -> Result<Self, LocalizerError> {
        let encoder = SceneEncoder::new(&(path / "encoder"), &config.encoder)?;
        let below = path / "regressor";
        Ok(Self {
            config: config.clone(),
            encoder,
            head: SgLocHead::new(&below, &config.encoder),
            norm: FeatureNorm::new(&(&below / "norm"), config.encoder.cell_channels()),
        })
    }

    /// `[N, 3]` world coordinates relative to the origin, metres, of some cells' features `[N, cell_channels]`, which
    /// lie at `sensor_m` `[N, 3]` in the sensor frame; computed in `kind`, with `train` as in batch normalisation.
    ///
    /// # Errors
    /// Those of the tensor library.
    pub fn coordinates(
        &self,
        cells: &Tensor,
        sensor_m: &Tensor,
        kind: Kind,
        train: bool,
    ) -> tch::Result<Tensor> {
        self.head
            .forward(&self.norm.forward(cells)?.f_to_kind(kind)?, sensor_m, train)
    }

    /// Sets the normalisation from features `[N, cell_channels]`; without it they enter unchanged.
    ///
    /// # Errors
    /// Those of the tensor library.
    pub fn set_statistics(&mut self, features: &Tensor) -> tch::Result<()> {
        self.norm.fit(features)
    }
}
