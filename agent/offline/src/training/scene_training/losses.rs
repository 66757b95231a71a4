//! What a head is trained towards.

use tch::{Kind, TchError, Tensor};

use localization::pgc::Regression;

/// Centres share a cell by their distance over this, metres.
const CENTRE_BLUR_M: f64 = 4.0;

/// Eq. 4 and 5, each cell by its weight; also the L1 errors `[N]`.
pub(super) fn weighted_loss(
    answer: &Regression,
    targets_m: &Tensor,
    weights: &Tensor,
) -> Result<(Tensor, Tensor), TchError> {
    let error = (&answer.coordinates_m - targets_m).f_abs()?.f_sum_dim_intlist(1_i64, false, Kind::Float)?;
    // The error is learnt from, not bent towards its prediction: the second term moves epsilon alone.
    let surprise = (error.f_detach()? - &answer.epsilon_m).f_abs()?;
    Ok((((&error + surprise) * weights).f_mean(Kind::Float)?, error))
}

/// Cross entropy between the shares of the centres and how near they really are.
///
/// Coordinates alone teach which centre is right only through their mean, which several wrong ones can make up together.
pub(super) fn centre_loss(
    log_shares: &Tensor,
    targets_m: &Tensor,
    centres_m: &Tensor,
    weights: &Tensor,
) -> Result<Tensor, TchError> {
    let distance = Tensor::f_cdist(targets_m, centres_m, 2.0, 1_i64)? / CENTRE_BLUR_M;
    let wanted = (distance.f_square()? * -0.5).f_softmax(1, Kind::Float)?;
    let each = (wanted * log_shares).f_sum_dim_intlist(1_i64, false, Kind::Float)?.f_neg()?;
    (each * weights).f_mean(Kind::Float)
}
