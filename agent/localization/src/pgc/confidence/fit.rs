//! Fit of a confidence model on sweeps with known poses.

use nalgebra::{SMatrix, SVector};
use serde::Serialize;

use super::isotonic::MonotoneMap;
use super::{ConfidenceModel, FEATURES, features};
use crate::pgc::pose_evidence::PoseEvidence;

/// Error above which a pose is bad, metres: the paper's limit of success.
pub const BAD_M: f64 = 3.0;

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
}

/// Checks the share of good poses that a fit may reject.
///
/// # Errors
/// [`FitError::GoodLoss`] unless it is at least 0 and below 1.
pub fn check_good_loss(good_loss: f64) -> Result<(), FitError> {
    match (0.0..1.0).contains(&good_loss) {
        true => Ok(()),
        false => Err(FitError::GoodLoss(good_loss)),
    }
}

impl ConfidenceModel {
    /// Fits weights, isotonic function and threshold; at most the share `good_loss` of good poses is rejected.
    ///
    /// # Errors
    /// [`FitError`] when there are too few sweeps, or `good_loss` is not at least 0 and below 1.
    pub fn fit(sweeps: &[Labelled], good_loss: f64) -> Result<(Self, FitReport), FitError> {
        check_good_loss(good_loss)?;
        let sweeps = sweeps.iter().filter(|sweep| sweep.error_m.is_finite());
        let sweeps: Vec<_> = sweeps.collect();
        if sweeps.len() < MIN_SWEEPS {
            return Err(FitError::TooFew(sweeps.len()));
        }
        let log_error = |error_m: f64| error_m.max(SMALLEST_ERROR_M).ln();
        let (rows, targets): (Vec<[f64; FEATURES]>, Vec<f64>) = (sweeps.iter())
            .map(|sweep| (features(&sweep.evidence), log_error(sweep.error_m)))
            .unzip();
        let (bias, weights) = non_negative_regression(&rows, &targets);
        let mut model = Self {
            bias,
            weights,
            sigma: MonotoneMap::falling(Vec::new()),
            reject_below: 0.0,
        };
        let samples = sweeps
            .iter()
            .map(|sweep| (model.log_error(&sweep.evidence), observed(sweep.error_m)));
        model.sigma = MonotoneMap::fit(samples.collect(), GROUPS.0, GROUPS.1);

        let sigmas: Vec<(f64, bool)> = sweeps
            .iter()
            .map(|sweep| (model.sigma(&sweep.evidence), sweep.error_m <= BAD_M))
            .collect();
        model.reject_below = threshold(&sigmas, good_loss);
        let count = |is_counted: &dyn Fn(&(f64, bool)) -> bool| {
            sigmas.iter().filter(|sigma| is_counted(sigma)).count()
        };
        let report = FitReport {
            sweeps: sweeps.len(),
            bad: count(&|(_, is_good)| !is_good),
            bad_rejected: count(&|(sigma, is_good)| !is_good && *sigma < model.reject_below),
            good_rejected: count(&|(sigma, is_good)| *is_good && *sigma < model.reject_below),
        };
        Ok((model, report))
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
    let lost = (good_loss * good.len() as f64).floor() as usize;
    good.get(lost).copied().unwrap_or(1.0)
}

/// Ridge regression with weights that are not negative, on standardised features, by coordinate descent.
fn non_negative_regression(rows: &[[f64; FEATURES]], targets: &[f64]) -> (f64, [f64; FEATURES]) {
    let count = rows.len() as f64;
    let row = |row: &[f64; FEATURES]| SVector::<f64, FEATURES>::from(*row);
    let mean = rows.iter().map(row).sum::<SVector<f64, FEATURES>>() / count;
    let target_mean = targets.iter().sum::<f64>() / count;
    let mut square = SMatrix::<f64, FEATURES, FEATURES>::zeros();
    let mut cross = SVector::<f64, FEATURES>::zeros();
    for (features, target) in rows.iter().map(row).zip(targets) {
        let centred = features - mean;
        square += centred * centred.transpose() / count;
        cross += centred * (target - target_mean) / count;
    }
    let scale: SVector<f64, FEATURES> = square.diagonal().map(|variance| variance.sqrt().max(1e-6));
    let mut weights = SVector::<f64, FEATURES>::zeros();
    for _ in 0..ROUNDS {
        for feature in 0..FEATURES {
            let ridge = RIDGE * scale[feature] * scale[feature];
            let curvature = square[(feature, feature)] + ridge + 1e-12;
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
    use crate::pgc::synthetic::SyntheticScene;
    use crate::statistics::spearman;

    /// Sweeps of a scene in which some places are hard and a few impossible to localize.
    fn sweeps(seeds: std::ops::Range<u64>) -> Vec<Labelled> {
        let sweep = |seed: u64| {
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
        };
        seeds.filter_map(sweep).collect()
    }

    #[test]
    fn a_fitted_confidence_ranks_and_is_calibrated_on_other_sweeps() {
        let (model, report) = ConfidenceModel::fit(&sweeps(0..600), 0.01).unwrap();
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
            ConfidenceModel::fit(&few, 0.01),
            Err(FitError::TooFew(few.len()))
        );
    }

    #[test]
    fn a_share_that_leaves_no_pose_is_rejected() {
        for good_loss in [1.0, -0.1, 1.5] {
            assert_eq!(
                ConfidenceModel::fit(&[], good_loss),
                Err(FitError::GoodLoss(good_loss))
            );
        }
        assert!(
            check_good_loss(f64::NAN).is_err()
                && check_good_loss(0.0).is_ok()
                && check_good_loss(0.99).is_ok()
        );
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
