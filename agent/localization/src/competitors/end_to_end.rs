//! Networks trained end to end on one scene: an encoder and a regressor, for the comparison in the paper.
//!
//! [`EndToEndKind::SgLoc`] keeps of SGLoc the position of a cell as a feature, the attention between scales, the residual head
//! with batch normalisation, the shift as output, the L1 loss and RANSAC. It has PGC's encoder, frozen, in place of one
//! of its own of 55 million parameters, a head of 2.7 million in place of 57, and no inter-geometric-consistency term,
//! which the published training code does not use either.
//!
//! [`EndToEndKind::Pose`] stands for absolute pose regression, from the features of a whole sweep. It has none of the
//! additions of HypLiLoc (a second branch on the spherical projection, hyperbolic fusion) and DiffLoc (features of a
//! foundation model, denoising over a window of sweeps), and it regresses heading only, since vehicles stand upright.

use serde::{Deserialize, Serialize};
use tch::nn;
use tch::{Kind, TchError, Tensor};

use super::sgloc_head::SgLocHead;
use crate::pgc::dense::Dense;
use crate::pgc::encoder_config::SceneEncoderConfig;
use crate::pgc::error::LocalizerError;
use crate::pgc::feature_norm::FeatureNorm;
use crate::pgc::scene_encoder::SceneEncoder;

/// Channels inside the regressor of poses.
const WIDTH: i64 = 512;
/// Unit of regressed coordinates, metres.
const SCALE_M: f64 = 100.0;

/// Target of the regression.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum EndToEndKind {
    /// World coordinates of cells, after SGLoc; a solver finds the pose.
    #[serde(rename = "sgloc")]
    SgLoc,
    /// The pose itself.
    Pose,
}

/// Configuration of a network that is trained end to end.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct EndToEndConfig {
    /// Target of the regression.
    pub regresses: EndToEndKind,
    /// Name of the scene.
    #[serde(rename = "town")]
    pub scene_name: String,
    /// Centre of the training positions, metres in the world.
    pub origin_m: [f64; 3],
    /// The encoder, trained with the regressor.
    pub encoder: SceneEncoderConfig,
}

/// Encoder and regressor of one scene.
#[derive(Debug)]
pub struct EndToEnd {
    config: EndToEndConfig,
    encoder: SceneEncoder,
    norm: FeatureNorm,
    regressor: Regressor,
}

/// Layers behind the encoder.
#[derive(Debug)]
enum Regressor {
    SgLoc(SgLocHead),
    Pose([Dense; 3]),
}

impl EndToEnd {
    /// Builds the layers below `path`.
    ///
    /// # Errors
    /// [`LocalizerError::Config`] names the field that is wrong.
    pub fn new(path: &nn::Path<'_>, config: &EndToEndConfig) -> Result<Self, LocalizerError> {
        let encoder = SceneEncoder::new(&(path / "encoder"), &config.encoder)?;
        let below = path / "regressor";
        let (inputs, regressor) = match config.regresses {
            EndToEndKind::SgLoc => {
                (config.encoder.cell_channels(), Regressor::SgLoc(SgLocHead::new(&below, &config.encoder)))
            }
            EndToEndKind::Pose => {
                let inputs = config.encoder.sweep_channels();
                let layer = |number: usize, from, to, gain| Dense::new(&(&below / number), from, to, gain);
                let layers = [layer(0, inputs, WIDTH, 1.0), layer(1, WIDTH, WIDTH, 1.0), layer(2, WIDTH, 5, 0.1)];
                (inputs, Regressor::Pose(layers))
            }
        };
        let norm = FeatureNorm::new(&(&below / "norm"), inputs);
        Ok(Self { config: config.clone(), encoder, norm, regressor })
    }

    /// Configuration that it was built from.
    #[must_use]
    pub fn config(&self) -> &EndToEndConfig {
        &self.config
    }

    /// Encoder.
    #[must_use]
    pub fn encoder(&self) -> &SceneEncoder {
        &self.encoder
    }

    /// `[N, 3]` world coordinates relative to the origin, metres, of some cells' features `[N, cell_channels]`, which
    /// lie at `sensor_m` `[N, 3]` in the sensor frame; `train` as in batch normalisation.
    ///
    /// # Errors
    /// Those of the tensor library; [`TchError::Shape`] if the network regresses something else.
    pub fn coordinates(&self, cells: &Tensor, sensor_m: &Tensor, train: bool) -> Result<Tensor, TchError> {
        match &self.regressor {
            Regressor::SgLoc(head) => head.forward(&self.norm.forward(cells)?, sensor_m, train),
            Regressor::Pose(_) => Err(TchError::Shape("this network regresses poses, not coordinates".into())),
        }
    }

    /// `[S, 3]` positions relative to the origin, metres, and `[S, 2]` cosine and sine of headings, of length 1, of the
    /// features `[S, sweep_channels]` of whole sweeps.
    ///
    /// # Errors
    /// Those of the tensor library; [`TchError::Shape`] if the network regresses something else.
    pub fn poses(&self, sweeps: &Tensor) -> Result<(Tensor, Tensor), TchError> {
        let Regressor::Pose([first, second, third]) = &self.regressor else {
            return Err(TchError::Shape("this network regresses coordinates, not poses".into()));
        };
        // In single precision, whatever the encoder computes in: bfloat16 resolves a position 200 m away to half a metre.
        let x = self.norm.forward(sweeps)?;
        let output = third.forward(&second.forward(&first.forward(&x)?.f_relu()?)?.f_relu()?)?;
        let heading = output.f_narrow(1, 3, 2)?;
        let norm = heading.f_square()?.f_sum_dim_intlist(1_i64, true, Kind::Float)?.f_add_scalar(1e-12)?.f_sqrt()?;
        Ok((output.f_narrow(1, 0, 3)? * SCALE_M, heading / norm))
    }

    /// Sets the normalisation from features `[N, cell_channels]` or `[N, sweep_channels]`; without it they enter
    /// unchanged.
    ///
    /// # Errors
    /// Those of the tensor library.
    pub fn set_statistics(&mut self, features: &Tensor) -> Result<(), TchError> {
        self.norm.fit(features)
    }
}
