//! Accuracy of a network that regresses poses: errors of positions.

use std::fmt;

use localization::baselines::{PoseRegressor, RegressPose};
use serde::Serialize;
use support::statistics::SUCCESS_M;
use tch::{Kind, TchError, Tensor, no_grad};

use super::token_cache::TokenSweeps;

/// Sweeps that are computed together.
const BATCH: i64 = 200;

/// Errors of sweeps by themselves.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct RegressionAccuracy {
    /// Median error of the position, metres.
    pub p50_m: f64,
    /// Share of sweeps with an error under 3 m.
    pub success_3m: f64,
}

impl fmt::Display for RegressionAccuracy {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let (p50_m, percent) = (self.p50_m, 100.0 * self.success_3m);
        write!(f, "median {p50_m:.2} m, {percent:.1} % under 3 m")
    }
}

/// Localizes sweeps, computing in `kind`.
pub(super) fn accuracy<N: RegressPose>(
    network: &PoseRegressor<N>,
    sweeps: &TokenSweeps,
    kind: Kind,
) -> Result<RegressionAccuracy, TchError> {
    let mut found = Vec::new();
    for tokens in sweeps.tokens.f_split(BATCH, 0)? {
        found.push(no_grad(|| {
            network.network.poses(&tokens, &network.places, kind)
        })?);
    }
    let off = Tensor::f_cat(&found, 0)?.f_sub(&sweeps.poses)?;
    let squares = off.f_narrow(1, 0, 3)?.f_square()?;
    let error = squares.f_sum_dim_intlist(1_i64, false, Kind::Float)?;
    let error = error.f_sqrt()?;
    let is_success = error.f_lt(SUCCESS_M)?.f_to_kind(Kind::Float)?;
    Ok(RegressionAccuracy {
        p50_m: error.f_median()?.f_double_value(&[])?,
        success_3m: is_success.f_mean(Kind::Float)?.f_double_value(&[])?,
    })
}
