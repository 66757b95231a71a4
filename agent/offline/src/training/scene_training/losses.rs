//! Losses of a head.

use tch::{Kind, TchError, Tensor};

use localization::pgc::Regression;

/// Scale of the distance in the target weights of the centres, metres.
const CENTRE_BLUR_M: f64 = 4.0;

/// Eq. 4 and 5 with a weight per cell; also the L1 errors `[N]`.
pub(super) fn weighted_loss(
    answer: &Regression,
    targets_m: &Tensor,
    weights: &Tensor,
) -> Result<(Tensor, Tensor), TchError> {
    let error = (&answer.coordinates_m - targets_m).f_abs()?;
    let error = error.f_sum_dim_intlist(1_i64, false, Kind::Float)?;
    // The error is the target of its prediction: the second term has a gradient for epsilon alone.
    let surprise = (error.f_detach()? - &answer.epsilon_m).f_abs()?;
    Ok((((&error + surprise) * weights).f_mean(Kind::Float)?, error))
}

/// Cross entropy between the weights of the centres and their true proximity.
///
/// The coordinate loss alone constrains only the mean of the centres, which several wrong ones can produce together.
pub(super) fn centre_loss(
    log_shares: &Tensor,
    targets_m: &Tensor,
    centres_m: &Tensor,
    weights: &Tensor,
) -> Result<Tensor, TchError> {
    let distance = Tensor::f_cdist(targets_m, centres_m, 2.0, 1_i64)? / CENTRE_BLUR_M;
    let wanted = (distance.f_square()? * -0.5).f_softmax(1, Kind::Float)?;
    let each = (wanted * log_shares).f_sum_dim_intlist(1_i64, false, Kind::Float)?;
    (each.f_neg()? * weights).f_mean(Kind::Float)
}
