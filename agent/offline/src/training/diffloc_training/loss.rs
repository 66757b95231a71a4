//! Loss of DiffLoc: L1 of the predicted noise, of the poses that it implies and of its differences between sweeps, and
//! cross entropy of the mask
//! and of places.

use tch::{Kind, Reduction, TchError, Tensor};

use super::augmentation::{Augmented, static_tokens};
use crate::training::place_classes::PlaceClasses;
use localization::baselines::diffloc::{CHANNELS, DiffLoc, Windows};

/// Noise levels and noises that are drawn for each window: the denoiser costs little beside the encoder.
const DRAWS: i64 = 8;
/// Share of these whose sweeps do not see each other, as in the localization of a single sweep.
const SINGLE: f64 = 0.5;
/// Largest weight of an error of the noise as an error of the pose. Where much noise hides a pose, which only the sweep
/// tells there, the published loss has little gradient: its training is long.
const LARGEST_POSE_WEIGHT: f64 = 5.0;
/// Weight of the differences between sweeps.
const DIFFERENCE_WEIGHT: f64 = 1.0;
/// Weight of the mask of static objects.
const MASK_WEIGHT: f64 = 0.1;
/// Weight of the classification of places.
const PLACE_WEIGHT: f64 = 0.5;

/// Result of a batch.
pub(super) struct Losses {
    /// Weighted sum, with gradient.
    pub(super) total: Tensor,
    /// Mean L1 of the noise, without gradient.
    pub(super) noise: Tensor,
    /// `[W, F, width]`: features of the sweeps, without gradient.
    pub(super) features: Tensor,
}

/// Losses of windows of `frames` sweeps, one after another.
pub(super) fn losses(
    network: &DiffLoc,
    places: &PlaceClasses,
    batch: &Augmented,
    frames: i64,
    kind: Kind,
) -> Result<Losses, TchError> {
    let images = batch.images.f_narrow(1, 0, CHANNELS as i64)?.f_to_kind(kind)?;
    let encoded = network.encoder().forward(&images, true)?;
    let statics = static_tokens(&batch.images, network.config().patch)?;
    let mask =
        encoded.static_logits.f_binary_cross_entropy_with_logits::<Tensor>(&statics, None, None, Reduction::Mean)?;
    let place = places.loss(&encoded.features, &batch.poses)?;
    let features = encoded.features.f_view([-1, frames, network.config().width])?;
    let NoiseLosses { noise, poses, differences } =
        noise_losses(network, &features, &batch.poses.f_view([-1, frames, 5])?)?;
    let total = &noise + poses + differences * DIFFERENCE_WEIGHT + mask * MASK_WEIGHT + place * PLACE_WEIGHT;
    Ok(Losses { total, noise: noise.f_detach()?, features: features.f_detach()? })
}

/// Parts of the loss that come from the denoiser.
struct NoiseLosses {
    /// Of the noise.
    noise: Tensor,
    /// Of the poses that the noise implies.
    poses: Tensor,
    /// Of the differences of the noise between sweeps that see each other.
    differences: Tensor,
}

fn noise_losses(network: &DiffLoc, features: &Tensor, poses: &Tensor) -> Result<NoiseLosses, TchError> {
    let drawn = |of: &Tensor| of.f_repeat([DRAWS, 1, 1]);
    let (features, poses) = (drawn(features)?, drawn(poses)?);
    let (count, frames, _) = poses.size3()?;
    let on = (Kind::Float, poses.device());
    let steps = Tensor::f_randint(network.schedule().steps(), [count], (Kind::Int64, on.1))?;
    let noise = Tensor::f_randn(poses.size(), on)?;
    let joint = Tensor::f_rand([count], on)?.f_ge(SINGLE)?.f_to_kind(Kind::Float)?;
    let noisy = network.schedule().add_noise(&poses, &noise, &steps)?;
    let error = network.denoiser().forward(&noisy, &steps, &features, Windows::Joint(&joint))?.f_sub(&noise)?;
    let weights = network.schedule().implied_error(&steps)?.f_clamp_max(LARGEST_POSE_WEIGHT)?;
    let poses = error.f_abs()?.f_mul(&weights)?.f_mean(Kind::Float)?;
    let noise = error.f_abs()?.f_mean(Kind::Float)?;
    if frames < 2 {
        return Ok(NoiseLosses { differences: noise.f_zeros_like()?, noise, poses });
    }
    let differences =
        error.f_diff::<Tensor>(1, 1, None, None)?.f_abs()?.f_mean_dim([1_i64, 2].as_slice(), false, Kind::Float)?;
    Ok(NoiseLosses { noise, poses, differences: differences.f_mul(&joint)?.f_mean(Kind::Float)? })
}
