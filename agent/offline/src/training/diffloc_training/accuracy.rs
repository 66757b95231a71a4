//! Accuracy of a DiffLoc network: errors of denoised positions.

use std::fmt;

use serde::Serialize;
use tch::{Kind, TchError, Tensor, no_grad};

use super::images::SweepImages;
use crate::training::pose_scale::PoseScale;
use localization::baselines::diffloc::{CHANNELS, DiffLoc, Windows};

/// Sweeps that are encoded together.
const BATCH: i64 = 64;

/// Errors of sweeps by themselves.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct DiffLocAccuracy {
    /// Median error of the position, metres.
    pub p50_m: f64,
    /// Share of sweeps with an error under 3 m.
    pub success_3m: f64,
}

impl fmt::Display for DiffLocAccuracy {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let (p50_m, percent) = (self.p50_m, 100.0 * self.success_3m);
        write!(f, "median {p50_m:.2} m, {percent:.1} % under 3 m")
    }
}

/// Localizes sweeps with features `[N, width]` and normalised poses `[N, 5]`.
pub(super) fn accuracy(
    network: &DiffLoc,
    features: &Tensor,
    truth: &Tensor,
    scale: &PoseScale,
) -> Result<DiffLocAccuracy, TchError> {
    let found = network.poses(&features.f_unsqueeze(1)?, Windows::Single)?;
    let off = found.f_squeeze_dim(1)?.f_sub(truth)?.f_narrow(1, 0, 3)?;
    let squares = off.f_mul(&scale.unit_m(found.device())?)?.f_square()?;
    let error = squares
        .f_sum_dim_intlist(1_i64, false, Kind::Float)?
        .f_sqrt()?;
    let is_success = error.f_lt(3.0)?.f_to_kind(Kind::Float)?;
    Ok(DiffLocAccuracy {
        p50_m: error.f_median()?.f_double_value(&[])?,
        success_3m: is_success.f_mean(Kind::Float)?.f_double_value(&[])?,
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
        let part = images.narrow(first, BATCH.min(images.len() - first))?;
        let part = part.f_narrow(1, 0, CHANNELS as i64)?.f_to_kind(kind)?;
        features.push(no_grad(|| network.encoder().forward(&part, false))?.features);
    }
    let features = Tensor::f_cat(&features, 0)?;
    accuracy(network, &features, &images.poses, &images.scale)
}
