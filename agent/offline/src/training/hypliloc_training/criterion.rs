//! Loss: for each branch that of AtLoc (Wang et al. 2020), absolute errors with learnt weights.

use tch::nn::{self, Init};
use tch::{Kind, TchError, Tensor};

use localization::baselines::hypliloc::{BranchPoses, NormalisedPoses};

/// Logarithms of the variances of position and heading at the start.
const START: [f32; 2] = [0.0, -3.0];
/// They are learnt as many times as fast as layers: the training is short, and until they fit, the heading outweighs
/// the position.
const RATE: f64 = 10.0;

/// Learnt weights of position and heading, for each branch its own.
pub(super) struct Criteria {
    /// `[3, 2]`, divided by [`RATE`].
    log_variances: Tensor,
}

impl Criteria {
    pub(super) fn new(path: &nn::Path<'_>) -> Self {
        let mut log_variances = path.var("log_variances", &[3, 2], Init::Const(0.0));
        tch::no_grad(|| {
            log_variances.copy_(&(Tensor::from_slice(&START) / RATE).expand([3, 2], false))
        });
        Self { log_variances }
    }

    /// Sum of the losses of the three branches; `truth` `[S, 5]`.
    pub(super) fn loss(&self, poses: &BranchPoses, truth: &Tensor) -> Result<Tensor, TchError> {
        let [true_position, true_heading] = [truth.f_narrow(1, 0, 3)?, truth.f_narrow(1, 3, 2)?];
        let mut errors = Vec::with_capacity(6);
        for NormalisedPoses { position, heading } in [&poses.points, &poses.image, &poses.fusion] {
            errors.push((position - &true_position).f_abs()?.f_mean(Kind::Float)?);
            errors.push((heading - &true_heading).f_abs()?.f_mean(Kind::Float)?);
        }
        let errors = Tensor::f_stack(&errors, 0)?.f_view([3, 2])?;
        let log_variances = &self.log_variances * RATE;
        (errors * (-&log_variances).f_exp()? + log_variances).f_sum(Kind::Float)
    }
}

/// `[2]` mean distance, metres, and mean heading error, radians; no gradient.
pub(super) fn mean_errors(
    found: &NormalisedPoses,
    truth: &Tensor,
    unit_m: &Tensor,
) -> Result<Tensor, TchError> {
    let off = (found.position.detach() - truth.f_narrow(1, 0, 3)?) * unit_m;
    let distance = off
        .f_square()?
        .f_sum_dim_intlist(1_i64, false, Kind::Float)?
        .f_sqrt()?;
    let heading = found.heading.f_detach()?;
    let (cosine, sine) = (heading.f_select(1, 0)?, heading.f_select(1, 1)?);
    let (true_cosine, true_sine) = (truth.f_select(1, 3)?, truth.f_select(1, 4)?);
    let across = &sine * &true_cosine - &cosine * &true_sine;
    let along = cosine * true_cosine + sine * true_sine;
    let angle = across.f_atan2(&along)?.f_abs()?;
    Tensor::f_stack(
        &[distance.f_mean(Kind::Float)?, angle.f_mean(Kind::Float)?],
        0,
    )
}

#[cfg(test)]
mod tests {
    use tch::nn::VarStore;
    use tch::{Device, no_grad};

    use super::*;

    fn rows<const N: usize>(values: [f32; N]) -> Tensor {
        Tensor::from_slice(&values).view([1, -1])
    }

    #[test]
    fn errors_are_in_metres_and_radians() {
        let found = NormalisedPoses {
            position: rows([0.3, 0.0, 0.0]),
            heading: rows([0.0, 0.2]),
        };
        let truth = rows([0.0, 0.2, 0.0, 1.0, 0.0]);
        let errors = mean_errors(&found, &truth, &Tensor::from_slice(&[10f32, 20.0, 1.0])).unwrap();
        let wanted = Tensor::from_slice(&[5.0, std::f32::consts::FRAC_PI_2]);
        assert!(errors.allclose(&wanted, 1e-5, 1e-5, false), "{errors:?}");
    }

    #[test]
    fn every_branch_counts_and_weights_begin_as_those_of_atloc() {
        let variables = VarStore::new(Device::Cpu);
        let criteria = Criteria::new(&variables.root());
        let pose = |off: f32| NormalisedPoses {
            position: rows([off; 3]),
            heading: rows([1.0 - off, 0.0]),
        };
        let truth = rows([0.0, 0.0, 0.0, 1.0, 0.0]);
        let loss = |offs: [f32; 3]| {
            let [points, image, fusion] = offs.map(pose);
            let poses = BranchPoses {
                points,
                image,
                fusion,
                features: [0.0; 3].map(|of| rows([of])),
            };
            no_grad(|| criteria.loss(&poses, &truth))
                .unwrap()
                .double_value(&[])
        };
        // Three times -3, and for an error of 0.1 in one branch 0.1 of the position and 0.05 e^3 of the heading.
        let more = 0.1 + 0.05 * 3f64.exp();
        for (offs, wanted) in [
            ([0.0; 3], -9.0),
            ([0.1, 0.0, 0.0], more - 9.0),
            ([0.0, 0.1, 0.1], 2.0 * more - 9.0),
        ] {
            assert!(
                (loss(offs) - wanted).abs() < 1e-4,
                "{offs:?}: {}",
                loss(offs)
            );
        }
    }
}
