//! Denoiser: predicts the velocity of noisy poses of the sweeps of a window from their features.

use tch::{Kind, Tensor, nn};

use super::transformer::{NORM_EPS, TransformerLayer};
use crate::baselines::layers::TokenNorm;
use crate::baselines::place_classes::POSE;
use crate::pgc::dense::Dense;
use perception::tensor_values::tensor;

/// Channels of the features of a sweep.
pub(super) const FEATURES: i64 = 256;
/// Channels.
const WIDTH: i64 = 192;
/// Layers.
const LAYERS: usize = 2;
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
    norm: TokenNorm,
    outward: [Dense; 2],
    /// `[HARMONICS]`.
    frequencies: Tensor,
    /// `[STEP_CHANNELS / 2]`.
    step_frequencies: Tensor,
}

impl PoseDenoiser {
    /// Builds the layers below `path`.
    ///
    /// # Errors
    /// Those of the tensor library.
    pub fn new(path: &nn::Path<'_>) -> tch::Result<Self> {
        let inputs = POSE * (2 * HARMONICS + 1) + STEP_CHANNELS + FEATURES + 1;
        let half = STEP_CHANNELS / 2;
        let harmonics = (0..HARMONICS).map(|power| (1_u32 << power) as f32);
        let of_step = (0..half).map(|k| LONGEST.powf(-(k as f64) / half as f64) as f32);
        Ok(Self {
            inward: Dense::new(&(path / "inward"), inputs, WIDTH, 0.7),
            layers: (0..LAYERS)
                .map(|number| {
                    TransformerLayer::new(&(path / "layers" / number), WIDTH, EXPANSION, 0.0)
                })
                .collect(),
            norm: TokenNorm::new(&(path / "norm"), WIDTH, NORM_EPS),
            outward: [
                Dense::new(&(path / "outward" / 0), WIDTH, LAST, 1.0),
                Dense::new(&(path / "outward" / 1), LAST, POSE, 0.1),
            ],
            frequencies: tensor(&harmonics.collect::<Vec<_>>(), &[-1], path.device())?,
            step_frequencies: tensor(&of_step.collect::<Vec<_>>(), &[-1], path.device())?,
        })
    }

    /// Velocity `[W, F, POSE]` of noisy `poses` of the same shape at steps `[W]`, from the features `[W, F, C]` of
    /// their sweeps, oldest first; single precision throughout. `joint` is `[W]` of 0 or 1: whether the sweeps of a
    /// window see each other; `None`: each sweep is alone.
    ///
    /// # Errors
    /// Those of the tensor library.
    pub fn forward(
        &self,
        poses: &Tensor,
        steps: &Tensor,
        features: &Tensor,
        joint: Option<&Tensor>,
    ) -> tch::Result<Tensor> {
        let (count, frames, _) = poses.size3()?;
        let on = (Kind::Float, poses.device());
        // 0 between sweeps that see each other, [`UNSEEN`] elsewhere.
        let single = Tensor::f_eye(frames, on)?.f_neg()?.f_add_scalar(1.0)?;
        let single = single
            .f_mul_scalar(UNSEEN)?
            .f_view([1, 1, frames, frames])?;
        let (mask, age) = match joint {
            None => (single, Tensor::f_ones([1, 1, 1], on)?),
            Some(joint) => {
                let alone = joint.f_neg()?.f_add_scalar(1.0)?;
                // The newest sweep is marked by 1, as one that is alone.
                let place = Tensor::f_linspace(0.0, 1.0, frames, on)?.f_view([1, -1, 1])?;
                let age = place.f_maximum(&alone.f_view([-1, 1, 1])?)?;
                (single * alone.f_view([-1, 1, 1, 1])?, age)
            }
        };
        let steps = self.embed_steps(steps)?.f_view([-1, 1, STEP_CHANNELS])?;
        let inputs = [
            self.embed_poses(poses)?,
            steps.f_expand([count, frames, -1], false)?,
            features.shallow_clone(),
            age.f_expand([count, frames, 1], false)?,
        ];
        let x = self.inward.forward(&Tensor::f_cat(&inputs, 2)?)?;
        let mut layers = self.layers.iter();
        let x = layers.try_fold(x, |x, layer| layer.forward(&x, Some(&mask), false))?;
        let hidden = self.outward[0].forward(&self.norm.forward(&x)?)?;
        self.outward[1].forward(&hidden.f_gelu("none")?)
    }

    /// A pose with sine and cosine of its multiples.
    fn embed_poses(&self, poses: &Tensor) -> tch::Result<Tensor> {
        let angles = poses
            .f_unsqueeze(3)?
            .f_mul(&self.frequencies)?
            .f_flatten(2, 3)?;
        Tensor::f_cat(&[poses, &angles.f_sin()?, &angles.f_cos()?], 2)
    }

    /// Sine and cosine of the step `[W]` at falling frequencies.
    fn embed_steps(&self, steps: &Tensor) -> tch::Result<Tensor> {
        let steps = steps.f_to_kind(Kind::Float)?.f_unsqueeze(1)?;
        let angles = steps.f_mul(&self.step_frequencies)?;
        Tensor::f_cat(&[angles.f_sin()?, angles.f_cos()?], 1)
    }
}
