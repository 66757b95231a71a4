//! Denoiser: predicts the velocity of noisy poses of the sweeps of a window from their features.

use tch::nn;
use tch::{Device, Kind, TchError, Tensor};

use super::config::DiffLocConfig;
use super::layer_norm::LayerNorm;
use super::transformer::{TransformerLayer, dense};
use crate::pgc::dense::Dense;

/// Numbers of a pose: position in units of the training positions' deviation, cosine and sine of the heading.
pub(super) const POSE: i64 = 5;
/// Frequencies of the harmonic embedding of a pose.
const HARMONICS: i64 = 10;
/// Channels of the embedding of the step.
const STEP_CHANNELS: i64 = 128;
/// Longest wavelength of the embedding of the step, steps.
const LONGEST: f64 = 10_000.0;
/// Channels of the perceptrons, relative to those of the denoiser.
const EXPANSION: i64 = 2;
/// Channels before the answer.
const LAST: i64 = 128;
/// Added to the attention between sweeps that must not see each other.
const UNSEEN: f64 = -1e9;

/// Transformer over the sweeps of a window.
#[derive(Debug)]
pub struct PoseDenoiser {
    inward: Dense,
    layers: Vec<TransformerLayer>,
    norm: LayerNorm,
    outward: [Dense; 2],
    /// `[HARMONICS]`.
    frequencies: Tensor,
    /// `[STEP_CHANNELS / 2]`.
    step_frequencies: Tensor,
}

/// Attention between the sweeps of a window.
#[derive(Debug, Clone, Copy)]
pub enum Windows<'a> {
    /// Each sweep is alone.
    Single,
    /// `[W]` of 0 or 1: whether the sweeps of a window see each other.
    Joint(&'a Tensor),
}

impl PoseDenoiser {
    /// Builds the layers below `path`.
    ///
    /// # Errors
    /// Those of the tensor library.
    pub fn new(path: &nn::Path<'_>, config: &DiffLocConfig) -> Result<Self, TchError> {
        let DiffLocConfig {
            denoiser_width: width,
            heads,
            denoiser_layers,
            ..
        } = *config;
        let inputs = POSE * (2 * HARMONICS + 1) + STEP_CHANNELS + config.width + 1;
        let layer = |number: usize| {
            TransformerLayer::new(&(path / "layers" / number), width, heads, EXPANSION, 0.0)
        };
        let half = STEP_CHANNELS / 2;
        let harmonics: Vec<f32> = (0..HARMONICS)
            .map(|power| (1_u32 << power) as f32)
            .collect();
        let of_step: Vec<f32> = (0..half)
            .map(|k| LONGEST.powf(-(k as f64) / half as f64) as f32)
            .collect();
        let table = |values: &[f32]| Tensor::f_from_slice(values)?.f_to_device(path.device());
        Ok(Self {
            inward: Dense::new(&(path / "inward"), inputs, width, 0.7),
            layers: (0..denoiser_layers).map(layer).collect(),
            norm: LayerNorm::new(&(path / "norm"), width),
            outward: [
                Dense::new(&(path / "outward" / 0), width, LAST, 1.0),
                Dense::new(&(path / "outward" / 1), LAST, POSE, 0.1),
            ],
            frequencies: table(&harmonics)?,
            step_frequencies: table(&of_step)?,
        })
    }

    /// Velocity `[W, F, POSE]` of noisy `poses` of the same shape at steps `[W]`, from the features `[W, F, width]` of
    /// their sweeps, oldest first; single precision throughout.
    ///
    /// # Errors
    /// Those of the tensor library.
    pub fn forward(
        &self,
        poses: &Tensor,
        steps: &Tensor,
        features: &Tensor,
        windows: Windows<'_>,
    ) -> Result<Tensor, TchError> {
        let (count, frames, _) = poses.size3()?;
        let on = (Kind::Float, poses.device());
        let (mask, age) = match windows {
            Windows::Single => (
                single_mask(frames, on.1)?.f_view([1, 1, frames, frames])?,
                Tensor::f_ones([1, 1, 1], on)?,
            ),
            Windows::Joint(joint) => {
                let alone = joint.f_neg()?.f_add_scalar(1.0)?;
                let mask = single_mask(frames, on.1)?.f_view([1, 1, frames, frames])?
                    * alone.f_view([-1, 1, 1, 1])?;
                // The newest sweep is marked by 1, as one that is alone.
                let place = Tensor::f_linspace(0.0, 1.0, frames, on)?.f_view([1, -1, 1])?;
                let alone = alone.f_view([-1, 1, 1])?;
                (mask, place.f_maximum(&alone)?)
            }
        };
        let steps = self
            .embed_steps(steps)?
            .f_view([-1, 1, STEP_CHANNELS])?
            .f_expand([count, frames, -1], false)?;
        let age = age.f_expand([count, frames, 1], false)?;
        let inputs = Tensor::f_cat(
            &[
                self.embed_poses(poses)?,
                steps,
                features.shallow_clone(),
                age,
            ],
            2,
        )?;
        let mut x = dense(&self.inward, &inputs)?;
        for layer in &self.layers {
            x = layer.forward(&x, Some(&mask), false)?;
        }
        let hidden = dense(&self.outward[0], &self.norm.forward(&x)?)?.f_gelu("none")?;
        dense(&self.outward[1], &hidden)
    }

    /// A pose with sine and cosine of its multiples.
    fn embed_poses(&self, poses: &Tensor) -> Result<Tensor, TchError> {
        let angles = poses
            .f_unsqueeze(3)?
            .f_mul(&self.frequencies)?
            .f_flatten(2, 3)?;
        Tensor::f_cat(
            &[poses.shallow_clone(), angles.f_sin()?, angles.f_cos()?],
            2,
        )
    }

    /// Sine and cosine of the step `[W]` at falling frequencies.
    fn embed_steps(&self, steps: &Tensor) -> Result<Tensor, TchError> {
        let angles = steps
            .f_to_kind(Kind::Float)?
            .f_unsqueeze(1)?
            .f_mul(&self.step_frequencies)?;
        Tensor::f_cat(&[angles.f_sin()?, angles.f_cos()?], 1)
    }
}

/// `[F, F]`: 0 on the diagonal, [`UNSEEN`] elsewhere.
fn single_mask(frames: i64, device: Device) -> Result<Tensor, TchError> {
    let on = (Kind::Float, device);
    Tensor::f_eye(frames, on)?
        .f_neg()?
        .f_add_scalar(1.0)?
        .f_mul_scalar(UNSEEN)
}
