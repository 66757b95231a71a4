//! Loss of DiffLoc: L1 of the poses and of their differences between sweeps, cross entropy of the mask and of places.

use tch::{Kind, Reduction, TchError, Tensor};

use super::augmentation::static_tokens;
use super::images::SweepBatch;
use crate::training::place_classes::PlaceClasses;
use localization::baselines::diffloc::{CHANNELS, DiffLoc, Windows};

/// Noise levels and noises that are drawn for each window: the denoiser costs little beside the encoder.
const DRAWS: i64 = 16;
/// Share of these whose sweeps do not see each other, as in the localization of a single sweep.
const SINGLE: f64 = 0.5;
/// Weight of the mask of static objects, relative to that of poses.
const MASK_WEIGHT: f64 = 0.03;
/// Weight of the classification of places, relative to that of poses.
const PLACE_WEIGHT: f64 = 0.15;

/// Result of a batch.
pub(super) struct Losses {
    /// Weighted sum, with gradient.
    pub(super) total: Tensor,
    /// Mean L1 of the normalised poses, without gradient.
    pub(super) pose: Tensor,
    /// Cross entropy of places, without gradient.
    pub(super) place: Tensor,
    /// `[W, F, width]`: features of the sweeps, without gradient.
    pub(super) features: Tensor,
}

/// Losses of windows of `frames` sweeps, one after another.
pub(super) fn losses(
    network: &DiffLoc,
    places: &PlaceClasses<1>,
    batch: &SweepBatch,
    frames: i64,
    kind: Kind,
) -> Result<Losses, TchError> {
    let images = batch.images.f_narrow(1, 0, CHANNELS as i64)?;
    let encoded = network.encoder().forward(&images.f_to_kind(kind)?, true)?;
    let statics = static_tokens(&batch.images, network.config().patch)?;
    let logits = &encoded.static_logits;
    let mask = logits.f_binary_cross_entropy_with_logits::<Tensor>(
        &statics,
        None,
        None,
        Reduction::Mean,
    )?;
    let place = places
        .losses([&encoded.features], &batch.poses)?
        .f_select(0, 0)?;
    let width = network.config().width;
    let features = encoded.features.f_view([-1, frames, width])?;
    let poses = batch.poses.f_view([-1, frames, 5])?;
    let [pose, differences] = pose_losses(network, &features, &poses)?;
    let total = &pose + differences + mask * MASK_WEIGHT + &place * PLACE_WEIGHT;
    Ok(Losses {
        total,
        pose: pose.f_detach()?,
        place: place.f_detach()?,
        features: features.f_detach()?,
    })
}

/// L1 of the poses, and of their differences between sweeps that see each other.
fn pose_losses(
    network: &DiffLoc,
    features: &Tensor,
    poses: &Tensor,
) -> Result<[Tensor; 2], TchError> {
    let drawn = |of: &Tensor| of.f_repeat([DRAWS, 1, 1]);
    let (features, poses) = (drawn(features)?, drawn(poses)?);
    let (count, frames, _) = poses.size3()?;
    let on = (Kind::Float, poses.device());
    let schedule = &network.schedule;
    // The larger of two: where noise hides the pose, it has to come from the features.
    let steps = Tensor::f_randint(schedule.steps(), [2, count], (Kind::Int64, on.1))?;
    let steps = steps.f_amax(0_i64, false)?;
    let noise = Tensor::f_randn(poses.size(), on)?;
    let joint = Tensor::f_rand([count], on)?
        .f_ge(SINGLE)?
        .f_to_kind(Kind::Float)?;
    let noisy = schedule.add_noise(&poses, &noise, &steps)?;
    let (denoiser, windows) = (&network.denoiser, Windows::Joint(&joint));
    let velocity = denoiser.forward(&noisy, &steps, &features, windows)?;
    let error = schedule.poses(&noisy, &velocity, &steps)?.f_sub(&poses)?;
    let mean = error.f_abs()?.f_mean(Kind::Float)?;
    if frames < 2 {
        let none = mean.f_zeros_like()?;
        return Ok([mean, none]);
    }
    let differences = error.f_diff::<Tensor>(1, 1, None, None)?.f_abs()?;
    let differences = differences.f_mean_dim([1_i64, 2].as_slice(), false, Kind::Float)?;
    Ok([mean, differences.f_mul(&joint)?.f_mean(Kind::Float)?])
}
