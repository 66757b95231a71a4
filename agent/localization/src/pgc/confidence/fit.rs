//! Fit of a confidence model on sweeps with known poses.

use nalgebra::{SMatrix, SVector};
use serde::Serialize;
use support::statistics::SUCCESS_M;

use super::isotonic::MonotoneMap;
use super::{ConfidenceModel, FEATURES, features};
use crate::pgc::pose_evidence::PoseEvidence;
use crate::statistics::share_limit;

/// Error above which a pose is bad, metres: the paper's limit of success.
pub const BAD_M: f64 = SUCCESS_M;

/// Fewest sweeps to fit on.
const MIN_SWEEPS: usize = 40;
/// Smallest error that is distinguished, metres.
const SMALLEST_ERROR_M: f64 = 0.01;
/// Strength of the ridge penalty, per sweep.
const RIDGE: f64 = 1e-3;
/// Rounds of coordinate descent; it converges in some hundred.
const ROUNDS: usize = 2000;
/// Groups of sweeps that the isotonic function to sigma is fitted on, and the fewest sweeps in one.
const GROUPS: (usize, usize) = (24, 8);

/// A pose estimated for a sweep, with its error.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Labelled {
    /// Evidence for the pose.
    pub evidence: PoseEvidence,
    /// Distance to the true position, metres.
    pub error_m: f64,
}

/// Results of a fit.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct FitReport {
    /// Number of sweeps with a pose.
    pub sweeps: usize,
    /// Number of these with an error above 3 m.
    pub bad: usize,
    /// Number of bad poses that are rejected.
    pub bad_rejected: usize,
    /// Number of good poses that are rejected.
    pub good_rejected: usize,
    /// Upper 95 % confidence limit of the share of bad poses among those that are not rejected, 0..=1.
    pub wrong_limit: f64,
}

/// Choice of the threshold below which poses are rejected.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Rejection {
    /// At most this share of the good poses is rejected.
    GoodLoss(f64),
    /// As few poses are rejected as leave at most this share of bad ones among the others, by its upper 95 % confidence
    /// limit; of too few sweeps for that, as leave the smallest limit.
    MaxWrong(f64),
}

/// Error of a fit.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum FitError {
    /// There are too few poses.
    #[error("a confidence is fitted on at least {MIN_SWEEPS} sweeps with a pose, there are {0}")]
    TooFew(usize),
    /// The share leaves no pose.
    #[error("the share of good poses that may be rejected is {0}, must be 0 to less than 1")]
    GoodLoss(f64),
    /// The share is none, or every threshold leaves it.
    #[error("the share of wrong poses that may be left is {0}, must be above 0 and below 1")]
    MaxWrong(f64),
}

impl Rejection {
    /// Checks the share.
    ///
    /// # Errors
    /// [`FitError`] with the share that is out of range.
    pub fn check(&self) -> Result<(), FitError> {
        match *self {
            Self::GoodLoss(share) if !(0.0..1.0).contains(&share) => Err(FitError::GoodLoss(share)),
            Self::MaxWrong(share) if !(share > 0.0 && share < 1.0) => {
                Err(FitError::MaxWrong(share))
            }
            _ => Ok(()),
        }
    }
}

impl ConfidenceModel {
    /// Fits weights, isotonic function and threshold.
    ///
    /// # Errors
    /// [`FitError`] when there are too few sweeps, or the share of `rejection` is out of range.
    pub fn fit(sweeps: &[Labelled], rejection: Rejection) -> Result<(Self, FitReport), FitError> {
        let usable: Vec<_> = (sweeps.iter().filter(|sweep| sweep.error_m.is_finite())).collect();
        if usable.len() < MIN_SWEEPS {
            return Err(FitError::TooFew(usable.len()));
        }
        // Bounded from below: the logarithm of an error of 0 would make the sums infinite.
        let targets = usable
            .iter()
            .map(|sweep| sweep.error_m.max(SMALLEST_ERROR_M).ln());
        let targets: Vec<f64> = targets.collect();
        let rows: Vec<_> = (usable.iter().map(|sweep| features(&sweep.evidence))).collect();
        let (bias, weights) = non_negative_regression(&rows, &targets);
        let mut model = Self {
            bias,
            weights,
            sigma: MonotoneMap::falling(Vec::new()),
            reject_below: 0.0,
        };
        // The weights are fitted first: sigma is a function of the log error that they predict.
        let samples = (usable.iter())
            .map(|sweep| (model.log_error(&sweep.evidence), observed(sweep.error_m)));
        model.sigma = MonotoneMap::fit(samples.collect(), GROUPS.0, GROUPS.1);
        let report = model.choose_threshold(sweeps, rejection)?;
        Ok((model, report))
    }

    /// Chooses the threshold anew.
    ///
    /// # Errors
    /// As [`Self::fit`].
    pub fn choose_threshold(
        &mut self,
        sweeps: &[Labelled],
        rejection: Rejection,
    ) -> Result<FitReport, FitError> {
        rejection.check()?;
        let sweeps = sweeps.iter().filter(|sweep| sweep.error_m.is_finite());
        let sigmas: Vec<(f64, bool)> = sweeps
            .map(|sweep| (self.sigma(&sweep.evidence), sweep.error_m <= BAD_M))
            .collect();
        if sigmas.len() < MIN_SWEEPS {
            return Err(FitError::TooFew(sigmas.len()));
        }
        self.reject_below = match rejection {
            Rejection::GoodLoss(share) => threshold(&sigmas, share),
            Rejection::MaxWrong(share) => threshold_of_risk(&sigmas, share),
        };
        let below = self.reject_below;
        let accepted = sigmas.iter().filter(|(sigma, _)| *sigma >= below);
        let wrong = accepted.clone().filter(|(_, is_good)| !is_good).count();
        let bad = sigmas.iter().filter(|(_, is_good)| !is_good).count();
        let (accepted, bad_rejected) = (accepted.count(), bad - wrong);
        Ok(FitReport {
            sweeps: sigmas.len(),
            bad,
            bad_rejected,
            good_rejected: sigmas.len() - accepted - bad_rejected,
            wrong_limit: share_limit(wrong, accepted),
        })
    }
}

/// Target sigma of an error: Eq. 6 with the true error in place of the predicted one.
pub fn observed(error_m: f64) -> f64 {
    1.0 / (1.0 + error_m * error_m)
}

/// The highest threshold below which at most a share `good_loss` of the good poses lies; 1, which rejects every pose,
/// without good ones.
fn threshold(sigmas: &[(f64, bool)], good_loss: f64) -> f64 {
    let good = sigmas.iter().filter(|(_, is_good)| *is_good);
    let mut good: Vec<f64> = good.map(|(sigma, _)| *sigma).collect();
    good.sort_by(f64::total_cmp);
    // The pose at the threshold itself is accepted: so many good ones are rejected, or fewer.
    let lost = (good_loss * good.len() as f64).floor() as usize;
    good.get(lost).copied().unwrap_or(1.0)
}

/// The lowest threshold above which the share of bad poses is at most `max_wrong`, by its upper confidence limit; where
/// none is, the one with the smallest limit.
fn threshold_of_risk(sigmas: &[(f64, bool)], max_wrong: f64) -> f64 {
    let mut falling = sigmas.to_vec();
    falling.sort_by(|a, b| b.0.total_cmp(&a.0));
    let (mut wrong, mut best) = (0, (1.0_f64, 1.0));
    for (index, (sigma, is_good)) in falling.iter().enumerate() {
        wrong += usize::from(!is_good);
        // Poses of one sigma are accepted together.
        if falling.get(index + 1).is_some_and(|next| next.0 == *sigma) {
            continue;
        }
        let limit = share_limit(wrong, index + 1);
        // Within the allowed share the lower threshold wins, beyond it only a smaller limit does.
        if limit <= best.0.max(max_wrong) {
            best = (limit, *sigma);
        }
    }
    best.1
}

/// Ridge regression with weights that are not negative, on standardised features, by coordinate descent.
fn non_negative_regression(rows: &[[f64; FEATURES]], targets: &[f64]) -> (f64, [f64; FEATURES]) {
    let count = rows.len() as f64;
    let rows = rows.iter().map(|row| SVector::<f64, FEATURES>::from(*row));
    let mean = rows.clone().sum::<SVector<f64, FEATURES>>() / count;
    let target_mean = targets.iter().sum::<f64>() / count;
    let mut square = SMatrix::<f64, FEATURES, FEATURES>::zeros();
    let mut cross = SVector::<f64, FEATURES>::zeros();
    for (features, target) in rows.zip(targets) {
        let centred = features - mean;
        square += centred * centred.transpose() / count;
        cross += centred * (target - target_mean) / count;
    }
    let scale: SVector<f64, FEATURES> = square.diagonal().map(|variance| variance.sqrt().max(1e-6));
    let mut weights = SVector::<f64, FEATURES>::zeros();
    for _ in 0..ROUNDS {
        for feature in 0..FEATURES {
            // The penalty is on standardised weights, the weights here are of raw features.
            let ridge = RIDGE * scale[feature] * scale[feature];
            let curvature = square[(feature, feature)] + ridge + 1e-12;
            // Coordinate descent: the exact minimum along this weight, the others held.
            let slope = cross[feature] - square.row(feature).transpose().dot(&weights)
                + square[(feature, feature)] * weights[feature];
            weights[feature] = (slope / curvature).max(0.0);
        }
    }
    (target_mean - weights.dot(&mean), weights.into())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::pgc::pose_solver::PoseSolver;
    use crate::pgc::test_scene::SyntheticScene;
    use crate::statistics::spearman;

    /// A sweep of a scene in which some places are hard and a few impossible to localize.
    fn sweep(seed: u64) -> Option<Labelled> {
        let hardness = (seed % 97) as f64 / 97.0;
        let scene = SyntheticScene {
            outliers: 0.1 + 0.6 * hardness,
            noise_m: 0.1 + 0.5 * hardness,
            cells: 250,
            ..SyntheticScene::default()
        };
        let is_hopeless = seed.is_multiple_of(10);
        let scene = if is_hopeless {
            SyntheticScene {
                outliers: 0.85,
                twins: 1.0,
                ..scene
            }
        } else {
            scene
        };
        let found = PoseSolver::default().solve(&scene.coordinates(seed)).ok()?;
        let off = scene
            .world_from_sensor(seed)
            .inv_mul(&found.world_from_sensor);
        Some(Labelled {
            evidence: found.evidence,
            error_m: off.translation.vector.norm(),
        })
    }

    fn sweeps(seeds: std::ops::Range<u64>) -> Vec<Labelled> {
        seeds.filter_map(sweep).collect()
    }

    #[test]
    fn a_fitted_confidence_ranks_and_is_calibrated_on_other_sweeps() {
        let (model, report) =
            ConfidenceModel::fit(&sweeps(0..600), Rejection::GoodLoss(0.01)).unwrap();
        assert!(
            report.bad > 5 && report.bad_rejected * 2 >= report.bad,
            "{report:?}"
        );
        assert!(model.weights.iter().all(|&weight| weight >= 0.0));
        let others = sweeps(5000..5600);
        let sigmas: Vec<f64> = others
            .iter()
            .map(|sweep| model.sigma(&sweep.evidence))
            .collect();
        let errors: Vec<f64> = others.iter().map(|sweep| sweep.error_m).collect();
        let correlation = spearman(&sigmas, &errors).unwrap();
        assert!(correlation < -0.6, "{correlation}");
        let mean =
            |values: &mut dyn Iterator<Item = f64>| values.sum::<f64>() / others.len() as f64;
        let gap = mean(&mut sigmas.iter().copied())
            - mean(&mut errors.iter().map(|&error| observed(error)));
        assert!(gap.abs() < 0.05, "{gap}");
        let good = others.iter().filter(|sweep| sweep.error_m <= BAD_M);
        let lost = good
            .clone()
            .filter(|sweep| model.sigma(&sweep.evidence) < model.reject_below)
            .count();
        assert!((lost as f64) < 0.02 * good.count() as f64, "{lost}");
    }

    #[test]
    fn a_few_sweeps_are_too_few() {
        let few = sweeps(0..20);
        assert_eq!(
            ConfidenceModel::fit(&few, Rejection::GoodLoss(0.01)),
            Err(FitError::TooFew(few.len()))
        );
    }

    #[test]
    fn a_share_that_leaves_no_pose_is_rejected() {
        for share in [1.0, -0.1, 1.5] {
            for (rejection, error) in [
                (Rejection::GoodLoss(share), FitError::GoodLoss(share)),
                (Rejection::MaxWrong(share), FitError::MaxWrong(share)),
            ] {
                let mut model = ConfidenceModel::example();
                assert_eq!(model.choose_threshold(&[], rejection), Err(error));
            }
        }
        assert!(Rejection::GoodLoss(f64::NAN).check().is_err());
        assert!(Rejection::MaxWrong(0.0).check().is_err());
        for share in [0.0, 0.99] {
            assert_eq!(Rejection::GoodLoss(share).check(), Ok(()));
        }
    }

    /// Numbers of wrong poses and of all poses that a threshold accepts.
    fn wrong_above(sigmas: &[(f64, bool)], below: f64) -> (usize, usize) {
        let accepted: Vec<_> = sigmas.iter().filter(|(sigma, _)| *sigma >= below).collect();
        let wrong = accepted.iter().filter(|(_, is_good)| !is_good).count();
        (wrong, accepted.len())
    }

    #[test]
    fn the_threshold_leaves_no_more_risk_than_allowed() {
        // 4,000 poses; of those below a sigma of 0.3 every tenth is bad.
        let sigmas: Vec<(f64, bool)> = (0..4000)
            .map(|k| (f64::from(k) / 4000.0, k >= 1200 || k % 10 > 0))
            .collect();
        let below = threshold_of_risk(&sigmas, 0.01);
        let (wrong, accepted) = wrong_above(&sigmas, below);
        assert!(wrong > 5 && share_limit(wrong, accepted) <= 0.01);
        let (wrong, accepted) = wrong_above(&sigmas, below - 20.0 / 4000.0);
        assert!(
            share_limit(wrong, accepted) > 0.01,
            "a lower one would leave more"
        );
        // 2,800 good poses do not show one in 2,000: the smallest limit is taken, that of no bad pose.
        let strict = threshold_of_risk(&sigmas, 0.0005);
        let (wrong, _) = wrong_above(&sigmas, strict);
        assert!(wrong == 0 && strict < 0.31, "{strict}");
    }

    #[test]
    fn the_threshold_costs_no_more_than_allowed() {
        let sigmas: Vec<(f64, bool)> = (0..100).map(|k| (f64::from(k) / 100.0, k > 4)).collect();
        let below = threshold(&sigmas, 0.02);
        assert_eq!(
            sigmas
                .iter()
                .filter(|(sigma, is_good)| *is_good && *sigma < below)
                .count(),
            1
        );
        assert_eq!(threshold(&[(0.9, false)], 0.02), 1.0);
    }
}
