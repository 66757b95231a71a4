//! Losses of the networks that regress poses from tokens.

use localization::baselines::RegressPose;
use localization::baselines::diffloc::DiffLoc;
use localization::baselines::hypliloc::HypLiLoc;
use localization::baselines::place_classes::PlaceClasses;
use tch::{Kind, Reduction, Result, Tensor};

use super::token_cache::TokenSweeps;

/// Weight of the classification of places.
const PLACE_WEIGHT: f64 = 0.3;
/// Label smoothing, as in LightLoc's classifier.
const LABEL_SMOOTHING: f64 = 0.1;
/// Deviation of a position before its class is looked up, metres: a neighbour that is taken for the true class has to
/// give the pose too.
const CLASS_NOISE_M: f64 = 4.0;
/// Noise levels and noises that are drawn for each window: the denoiser costs little beside the tokens.
const DRAWS: i64 = 8;
/// Share of these whose sweeps do not see each other, as in the localization of a single sweep.
const SINGLE: f64 = 0.5;
/// Weight of the mask of static objects, relative to that of poses.
const MASK_WEIGHT: f64 = 0.03;
/// Share of a training after which HypLiLoc learns the weights of position and heading.
const WEIGHTS_LEARNT_FROM: f64 = 1.0 / 3.0;

/// A network that can be trained.
pub(super) trait PoseLoss: RegressPose {
    /// Sweeps of a window.
    const FRAMES: i64;

    /// Losses of windows, one after another, when a share of the training is done: the weighted sum, with gradient; and
    /// without it the mean L1 of the poses and the cross entropy of places.
    fn losses(
        &self,
        batch: &TokenSweeps,
        places: &PlaceClasses,
        kind: Kind,
        share_done: f64,
    ) -> Result<(Tensor, [Tensor; 2])>;
}

/// The true classes of poses, and those near which the network shall state them, with the poses relative to these.
fn classes(poses: &Tensor, places: &PlaceClasses) -> Result<[Tensor; 3]> {
    let noise = poses.f_randn_like()?.f_narrow(1, 0, 3)? * CLASS_NOISE_M;
    let moved = poses.f_narrow(1, 0, 3)?.f_add(&noise)?;
    let moved = Tensor::f_cat(&[moved, poses.f_narrow(1, 3, 2)?], 1)?;
    let near = places.nearest(&moved)?;
    let relative = places.relative(poses, &near)?;
    Ok([places.nearest(poses)?, near, relative])
}

fn cross_entropy(logits: &Tensor, classes: &Tensor) -> Result<Tensor> {
    let mean = Reduction::Mean;
    logits.f_cross_entropy_loss(classes, None::<Tensor>, mean, -100, LABEL_SMOOTHING)
}

impl PoseLoss for DiffLoc {
    const FRAMES: i64 = 3;

    /// L1 of the poses and of their differences between sweeps, cross entropy of the mask and of places.
    fn losses(
        &self,
        batch: &TokenSweeps,
        places: &PlaceClasses,
        kind: Kind,
        _share_done: f64,
    ) -> Result<(Tensor, [Tensor; 2])> {
        let described = self.describe(&batch.tokens, kind, true)?;
        let (logits, statics) = (&described.static_logits, &batch.statics);
        let mean = Reduction::Mean;
        let mask =
            logits.f_binary_cross_entropy_with_logits::<Tensor>(statics, None, None, mean)?;
        let [truth, near, relative] = classes(&batch.poses, places)?;
        let place = cross_entropy(&described.places, &truth)?;
        let features = self.of_class(&described.features, &near)?;
        let width = features.size()[1];
        let features = features.f_view([-1, Self::FRAMES, width])?;
        let poses = relative.f_view([-1, Self::FRAMES, 5])?;
        let [pose, differences] = denoising_losses(self, &features, &poses)?;
        let total = &pose + differences + mask * MASK_WEIGHT + &place * PLACE_WEIGHT;
        Ok((total, [pose.f_detach()?, place.f_detach()?]))
    }
}

/// L1 of the poses, and of their differences between sweeps that see each other.
fn denoising_losses(network: &DiffLoc, features: &Tensor, poses: &Tensor) -> Result<[Tensor; 2]> {
    let features = features.f_repeat([DRAWS, 1, 1])?;
    let poses = poses.f_repeat([DRAWS, 1, 1])?;
    let count = poses.size()[0];
    let on = (Kind::Float, poses.device());
    let schedule = &network.schedule;
    // The larger of two: where noise hides the pose, it has to come from the features.
    let steps = Tensor::f_randint(schedule.steps(), [2, count], (Kind::Int64, on.1))?;
    let steps = steps.f_amax(0_i64, false)?;
    let noise = Tensor::f_randn(poses.size(), on)?;
    let joint = Tensor::f_rand([count], on)?.f_ge(SINGLE)?;
    let joint = joint.f_to_kind(Kind::Float)?;
    let noisy = schedule.add_noise(&poses, &noise, &steps)?;
    let denoiser = &network.denoiser;
    let velocity = denoiser.forward(&noisy, &steps, &features, Some(&joint))?;
    let error = schedule.poses(&noisy, &velocity, &steps)?.f_sub(&poses)?;
    // The difference of two errors is the error of the difference.
    let differences = error.f_diff::<Tensor>(1, 1, None, None)?.f_abs()?;
    let differences = differences.f_mean_dim([1_i64, 2].as_slice(), false, Kind::Float)?;
    let differences = differences.f_mul(&joint)?.f_mean(Kind::Float)?;
    Ok([error.f_abs()?.f_mean(Kind::Float)?, differences])
}

impl PoseLoss for HypLiLoc {
    const FRAMES: i64 = 1;

    /// For each branch that of AtLoc (Wang et al. 2020), absolute errors with learnt weights, and the cross entropy of
    /// places. The weights are fixed at first: until position and heading fit, they say nothing.
    fn losses(
        &self,
        batch: &TokenSweeps,
        places: &PlaceClasses,
        kind: Kind,
        share_done: f64,
    ) -> Result<(Tensor, [Tensor; 2])> {
        let features = self.features(&batch.tokens, kind, true)?;
        let [truth, near, relative] = classes(&batch.poses, places)?;
        let (mut errors, mut entropies) = (Vec::new(), Vec::new());
        for (branch, features) in self.branches.iter().zip(&features) {
            entropies.push(cross_entropy(&branch.classify(features)?, &truth)?);
            let error = branch.poses(features, &near)?.f_sub(&relative)?.f_abs()?;
            errors.push(error.f_narrow(1, 0, 3)?.f_mean(Kind::Float)?);
            errors.push(error.f_narrow(1, 3, 2)?.f_mean(Kind::Float)?);
        }
        let errors = Tensor::f_stack(&errors, 0)?.f_view([3, 2])?;
        let place = Tensor::f_stack(&entropies, 0)?.f_sum(Kind::Float)?;
        let log_variances = match share_done < WEIGHTS_LEARNT_FROM {
            true => self.log_variances.f_detach()?,
            false => self.log_variances.shallow_clone(),
        };
        // Error * exp(-s) + s, where s is the learnt logarithm of the variance.
        let weighted = &errors * (-&log_variances).f_exp()? + log_variances;
        let total = weighted.f_sum(Kind::Float)? + &place * PLACE_WEIGHT;
        // The third branch, the fusion, gives the result.
        let pose = errors.f_detach()?.f_get(2)?.f_mean(Kind::Float)?;
        Ok((total, [pose, place.f_detach()? / 3.0]))
    }
}
