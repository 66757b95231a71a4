//! The network of DiffLoc: encoder of sweeps, denoiser of poses, and the way from one to the other.

use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, StandardNormal};
use tch::{Kind, TchError, Tensor, nn, no_grad};

use super::config::DiffLocConfig;
use super::denoiser::{POSE, PoseDenoiser, Windows};
use super::noise_schedule::NoiseSchedule;
use super::sweep_encoder::SweepEncoder;
use crate::pgc::LocalizerError;
use perception::tensor_values::tensor;

/// Steps from noise to poses.
const DENOISING_STEPS: usize = 10;
/// Seed of the noise that every search starts from.
const START_SEED: u64 = 7;

/// Encoder and denoiser of one scene.
#[derive(Debug)]
pub struct DiffLoc {
    config: DiffLocConfig,
    encoder: SweepEncoder,
    /// Denoiser of poses.
    pub denoiser: PoseDenoiser,
    /// Noise schedule.
    pub schedule: NoiseSchedule,
}

impl DiffLoc {
    /// Builds the layers below `path`.
    ///
    /// # Errors
    /// [`LocalizerError::Config`] names the field that is wrong; those of the tensor library.
    pub fn new(path: &nn::Path<'_>, config: &DiffLocConfig) -> Result<Self, LocalizerError> {
        config.validate()?;
        Ok(Self {
            config: config.clone(),
            encoder: SweepEncoder::new(&(path / "encoder"), config),
            denoiser: PoseDenoiser::new(&(path / "denoiser"), config)?,
            schedule: NoiseSchedule::new(path.device())?,
        })
    }

    /// Configuration that it was built from.
    pub fn config(&self) -> &DiffLocConfig {
        &self.config
    }

    /// Encoder of range images.
    pub fn encoder(&self) -> &SweepEncoder {
        &self.encoder
    }

    /// Normalised poses `[W, F, 5]` (position in deviations from the mean, cosine and sine of the heading) of sweeps
    /// with features `[W, F, width]`, oldest first; without gradients. The same features give the same poses.
    ///
    /// # Errors
    /// Those of the tensor library.
    pub fn poses(&self, features: &Tensor, windows: Windows<'_>) -> Result<Tensor, TchError> {
        let (count, frames, _) = features.size3()?;
        let device = features.device();
        let mut random = ChaCha8Rng::seed_from_u64(START_SEED);
        let noise = (0..POSE).map(|_| StandardNormal.sample(&mut random));
        let start = tensor::<f32>(&noise.collect::<Vec<_>>(), &[POSE], device)?;
        let start = start.f_expand([count, frames, POSE], false)?;
        let velocity = |noisy: &Tensor, step| {
            let steps = Tensor::f_full([count], step, (Kind::Int64, device))?;
            self.denoiser.forward(noisy, &steps, features, windows)
        };
        no_grad(|| self.schedule.denoise(&start, DENOISING_STEPS, velocity))
    }
}
