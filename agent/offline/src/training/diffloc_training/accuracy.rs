//! Accuracy of a DiffLoc network: errors of denoised positions.

use tch::{Kind, TchError, Tensor, no_grad};

use super::images::{Normalisation, SweepImages};
use localization::baselines::diffloc::{CHANNELS, DiffLoc, Windows};

/// Sweeps that are encoded together.
const BATCH: i64 = 64;

/// Errors of sweeps by themselves.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct DiffLocAccuracy {
    /// Median error of the position, metres.
    pub p50_m: f64,
    /// Share of sweeps with an error under 3 m.
    pub success_3m: f64,
}

/// Localizes sweeps with features `[N, width]` and normalised poses `[N, 5]`.
pub(super) fn accuracy(
    network: &DiffLoc,
    features: &Tensor,
    truth: &Tensor,
    normalisation: &Normalisation,
) -> Result<DiffLocAccuracy, TchError> {
    let found = network
        .poses(&features.f_unsqueeze(1)?, Windows::Single)?
        .f_squeeze_dim(1)?;
    let scale = Tensor::f_from_slice(&normalisation.scale_m.map(|scale| scale as f32))?
        .f_to_device(found.device())?;
    let error = found
        .f_sub(truth)?
        .f_narrow(1, 0, 3)?
        .f_mul(&scale)?
        .f_square()?;
    let error = error
        .f_sum_dim_intlist(1_i64, false, Kind::Float)?
        .f_sqrt()?;
    Ok(DiffLocAccuracy {
        p50_m: error.f_median()?.f_double_value(&[])?,
        success_3m: error
            .f_lt(3.0)?
            .f_to_kind(Kind::Float)?
            .f_mean(Kind::Float)?
            .f_double_value(&[])?,
    })
}

/// Localizes every sweep of `images`, which are normalised as those of the training.
pub(super) fn validate(
    network: &DiffLoc,
    images: &SweepImages,
    kind: Kind,
) -> Result<DiffLocAccuracy, TchError> {
    let mut features = Vec::new();
    for first in (0..images.len()).step_by(BATCH as usize) {
        let part = images
            .narrow(first, BATCH.min(images.len() - first))?
            .images;
        let part = part.f_narrow(1, 0, CHANNELS as i64)?.f_to_kind(kind)?;
        features.push(no_grad(|| network.encoder().forward(&part, false))?.features);
    }
    let truth = images.narrow(0, images.len())?.poses;
    accuracy(
        network,
        &Tensor::f_cat(&features, 0)?,
        &truth,
        &images.normalisation,
    )
}
