//! Competitors of the localizer that are trained end to end on one town: what the paper compares itself with. They are no
//! re-implementations of those works; each keeps their idea and leaves out what they build around it.
//!
//! `scene_coordinates` stands for SGLoc: coordinates of cells regressed without classification and without predicted error,
//! all cells trusted alike by the solver. It has our encoder in place of SGLoc's, and neither its tri-scale attention nor
//! its inter-geometric-consistency term.
//!
//! `pose` stands for absolute pose regression, HypLiLoc and DiffLoc: one network from a sweep to a pose. It has none of
//! what these add to that idea (HypLiLoc's second branch on the spherical projection and its hyperbolic fusion; DiffLoc's
//! foundation-model features and its denoising over a window of sweeps), and it regresses heading only, since vehicles
//! stand upright.
//!
//! Both have our encoder (`lean`), the localizer's sweeps and a comparable time of training, not the hours on a GPU that
//! the papers spend: so the comparison is one of ideas at equal means. In that time a whole network learns nothing from
//! nothing; with the localizer's own encoder, frozen, only its last layers have to.

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

/// What is regressed.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum EndToEndKind {
    /// World coordinates of cells; a solver finds the pose.
    SceneCoordinates,
    /// The pose itself.
    Pose,
}

/// A network that is trained end to end.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct EndToEndConfig {
    /// What is regressed.
    pub regresses: EndToEndKind,
    /// Name of the town.
    pub town: String,
    /// Middle of the training positions, metres in the world.
    pub origin_m: [f64; 3],
    /// The encoder, trained with the rest.
    pub encoder: SceneEncoderConfig,
}

/// Encoder and regressor of one town.
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

    /// What it was built from.
    #[must_use]
    pub fn config(&self) -> &EndToEndConfig {
        &self.config
    }

    /// Its encoder.
    #[must_use]
    pub fn encoder(&self) -> &SceneEncoder {
        &self.encoder
    }

    /// `[cells, 3]` world coordinates relative to the origin, metres, of some cells' features.
    ///
    /// # Errors
    /// The tensor library's.
    pub fn coordinates(&self, cells: &Tensor) -> Result<Tensor, TchError> {
        Ok(self.regress(cells)? * SCALE_M)
    }

    /// `[S, 3]` positions relative to the origin, metres, and `[S, 2]` cosine and sine of headings, of length 1, of the
    /// features `[S, sweep_channels]` of whole sweeps.
    ///
    /// # Errors
    /// The tensor library's.
    pub fn poses(&self, sweeps: &Tensor) -> Result<(Tensor, Tensor), TchError> {
        let output = self.regress(sweeps)?;
        let heading = output.f_narrow(1, 3, 2)?;
        let norm = heading.f_square()?.f_sum_dim_intlist(1_i64, true, Kind::Float)?.f_add_scalar(1e-12)?.f_sqrt()?;
        Ok((output.f_narrow(1, 0, 3)? * SCALE_M, heading / norm))
    }

    /// Takes what features look like, `[N, cell_channels]` or `[N, sweep_channels]`; without that they are regressed from as
    /// they are.
    ///
    /// # Errors
    /// The tensor library's.
    pub fn set_statistics(&mut self, features: &Tensor) -> Result<(), TchError> {
        self.norm.fit(features)
    }

    /// In single precision, whatever the encoder computes in: bfloat16 knows a place 200 m away to half a metre.
    fn regress(&self, x: &Tensor) -> Result<Tensor, TchError> {
        let [first, second, third] = &self.layers;
        let x = second.forward(&first.forward(&self.norm.forward(x)?)?.f_relu()?)?.f_relu()?;
        third.forward(&x)
    }
}
