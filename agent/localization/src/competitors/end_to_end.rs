//! Competitors of the localizer, trained end to end on one scene, for the comparison in the paper. They are no
//! re-implementations of those works; each keeps their idea and leaves out what they build around it.
//!
//! `scene_coordinates` stands for SGLoc: coordinates of cells regressed without classification and without predicted
//! error; the solver weighs all cells equally. It has our encoder in place of SGLoc's, and neither its tri-scale
//! attention nor its inter-geometric-consistency term.
//!
//! `pose` stands for absolute pose regression, HypLiLoc and DiffLoc: one network from a sweep to a pose. It has none of
//! the additions of these works (HypLiLoc's second branch on the spherical projection and its hyperbolic fusion;
//! DiffLoc's foundation-model features and its denoising over a window of sweeps), and it regresses heading only, since
//! vehicles stand upright.
//!
//! Both have our encoder (`lean`), the localizer's sweeps and a comparable time of training, not the GPU hours of the
//! papers: the comparison is one of ideas at equal cost. In that time a network that starts from random weights does
//! not converge; with the localizer's own encoder, frozen, only the last layers are trained.

use serde::{Deserialize, Serialize};
use tch::nn;
use tch::{Kind, TchError, Tensor};

use crate::pgc::dense::Dense;
use crate::pgc::encoder_config::SceneEncoderConfig;
use crate::pgc::error::LocalizerError;
use crate::pgc::feature_norm::FeatureNorm;
use crate::pgc::scene_encoder::SceneEncoder;

/// Channels inside the regressors.
const WIDTH: i64 = 512;
/// Unit of regressed coordinates, metres.
const SCALE_M: f64 = 100.0;

/// Target of the regression.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum EndToEndKind {
    /// World coordinates of cells; a solver finds the pose.
    SceneCoordinates,
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
    layers: [Dense; 3],
}

impl EndToEnd {
    /// Builds the layers below `path`.
    ///
    /// # Errors
    /// [`LocalizerError::Config`] names the field that is wrong.
    pub fn new(path: &nn::Path<'_>, config: &EndToEndConfig) -> Result<Self, LocalizerError> {
        let encoder = SceneEncoder::new(&(path / "encoder"), &config.encoder)?;
        let (inputs, outputs) = match config.regresses {
            EndToEndKind::SceneCoordinates => (config.encoder.cell_channels(), 3),
            EndToEndKind::Pose => (config.encoder.sweep_channels(), 5),
        };
        let norm = FeatureNorm::new(&(path / "regressor" / "norm"), inputs);
        let layer = |number: usize, from, to, gain| Dense::new(&(path / "regressor" / number), from, to, gain);
        let layers = [layer(0, inputs, WIDTH, 1.0), layer(1, WIDTH, WIDTH, 1.0), layer(2, WIDTH, outputs, 0.1)];
        Ok(Self { config: config.clone(), encoder, norm, layers })
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

    /// `[cells, 3]` world coordinates relative to the origin, metres, of some cells' features.
    ///
    /// # Errors
    /// Those of the tensor library.
    pub fn coordinates(&self, cells: &Tensor) -> Result<Tensor, TchError> {
        Ok(self.regress(cells)? * SCALE_M)
    }

    /// `[S, 3]` positions relative to the origin, metres, and `[S, 2]` cosine and sine of headings, of length 1, of the
    /// features `[S, sweep_channels]` of whole sweeps.
    ///
    /// # Errors
    /// Those of the tensor library.
    pub fn poses(&self, sweeps: &Tensor) -> Result<(Tensor, Tensor), TchError> {
        let output = self.regress(sweeps)?;
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

    /// In single precision, whatever the encoder computes in: bfloat16 resolves a position 200 m away to half a metre.
    fn regress(&self, x: &Tensor) -> Result<Tensor, TchError> {
        let [first, second, third] = &self.layers;
        let x = second.forward(&first.forward(&self.norm.forward(x)?)?.f_relu()?)?.f_relu()?;
        third.forward(&x)
    }
}
