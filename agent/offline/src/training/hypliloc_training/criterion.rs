//! Loss: for each branch that of AtLoc (Wang et al. 2020), absolute errors with learnt weights.

use tch::nn::{self, Init};
use tch::{Kind, TchError, Tensor};

use super::examples::Truth;
use localization::competitors::hypliloc::{BranchPoses, NormalisedPoses};

/// Logarithms of the variances of position and heading at the start.
const START: [f32; 2] = [0.0, -3.0];

/// Learnt weights of position and heading, for each branch its own.
pub(super) struct Criteria {
    /// `[3, 2]`
    log_variances: Tensor,
}

impl Criteria {
    pub(super) fn new(path: &nn::Path<'_>) -> Self {
        let mut log_variances = path.var("log_variances", &[3, 2], Init::Const(0.0));
        tch::no_grad(|| log_variances.copy_(&Tensor::from_slice(&START).expand([3, 2], false)));
        Self { log_variances }
    }

    /// Sum of the losses of the three branches.
    pub(super) fn loss(&self, poses: &BranchPoses, truth: &Truth) -> Result<Tensor, TchError> {
        let mut errors = Vec::with_capacity(6);
        for NormalisedPoses { position, heading } in [&poses.points, &poses.image, &poses.fusion] {
            errors.push((position - &truth.position).f_abs()?.f_mean(Kind::Float)?);
            errors.push((heading - &truth.heading).f_abs()?.f_mean(Kind::Float)?);
        }
        let errors = Tensor::f_stack(&errors, 0)?.f_view([3, 2])?;
        (errors * (-&self.log_variances).f_exp()? + &self.log_variances).f_sum(Kind::Float)
    }
}

/// `[2]` mean distance, metres, and mean heading error, radians; no gradient.
pub(super) fn mean_errors(found: &NormalisedPoses, truth: &Truth, scale_m: &Tensor) -> Result<Tensor, TchError> {
    let off = (found.position.detach() - &truth.position) * scale_m;
    let distance = off.f_square()?.f_sum_dim_intlist(1_i64, false, Kind::Float)?.f_sqrt()?;
    let parts = |heading: &Tensor| Ok::<_, TchError>((heading.f_select(1, 0)?, heading.f_select(1, 1)?));
    let ((cosine, sine), (true_cosine, true_sine)) = (parts(&found.heading.detach())?, parts(&truth.heading)?);
    let across = &sine * &true_cosine - &cosine * &true_sine;
    let along = cosine * true_cosine + sine * true_sine;
    let angle = across.f_atan2(&along)?.f_abs()?;
    Tensor::f_stack(&[distance.f_mean(Kind::Float)?, angle.f_mean(Kind::Float)?], 0)
}
