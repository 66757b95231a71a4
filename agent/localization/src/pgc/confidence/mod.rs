//! How far to trust a pose: from what speaks for it to one number, sigma.
//!
//! Sigma is calibrated when poses with sigma `s` have errors `e` with a mean of `1 / (1 + e^2)` of `s`, `e` in metres: what
//! Eq. 6 of the paper says of a cell, said of a pose. Without calibration it is the mean of the inliers' confidences times
//! their share.

mod fit;
mod isotonic;

use serde::{Deserialize, Serialize};

pub use fit::{BAD_M, FitError, FitReport, Labelled, check_good_loss, observed};
pub use isotonic::MonotoneMap;

use super::pose_evidence::{PoseEvidence, RefinementEvidence};

/// Number of features of [`PoseEvidence`].
const FEATURES: usize = 14;

/// Metadata key of a head's file that the [`ConfidenceModel`] of its town lies under, as JSON.
pub const CONFIDENCE_KEY: &str = "confidence";

/// Beyond this no fit gets with its weights and bias, by far; sums of so many and such features are numbers.
const MAX_WEIGHT: f64 = 1e9;

/// How sigma is computed.
#[derive(Debug, Clone, PartialEq, Default)]
pub enum Confidence {
    /// Mean confidence of the inliers times their share; nothing is withheld.
    #[default]
    Plain,
    /// Fitted on sweeps whose poses are known.
    Calibrated(ConfidenceModel),
}

impl Confidence {
    /// Sigma of a pose, 0..=1.
    #[must_use]
    pub fn sigma(&self, evidence: &PoseEvidence) -> f64 {
        match self {
            Self::Plain => evidence.plain_sigma(),
            Self::Calibrated(model) => model.sigma(evidence),
        }
    }

    /// Whether a pose of this sigma is kept back.
    #[must_use]
    pub fn withholds(&self, sigma: f64) -> bool {
        match self {
            Self::Plain => false,
            Self::Calibrated(model) => sigma < model.withhold_below,
        }
    }
}

/// Sigma as a monotone map of a weighted sum of what speaks against a pose.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ConfidenceModel {
    /// Expected logarithm of the error in metres where all features are 0.
    pub bias: f64,
    /// Weight of each feature, none below 0: what speaks against a pose never helps it, however far a sweep lies from those
    /// that were fitted on.
    pub weights: [f64; FEATURES],
    /// From the expected logarithm of the error to sigma, falling.
    pub sigma: MonotoneMap,
    /// Poses of a lower sigma are kept back.
    pub withhold_below: f64,
}

impl ConfidenceModel {
    /// Checks numbers that come from a file: that they are such as a fit has.
    ///
    /// # Errors
    /// Says which field is wrong and what stood there.
    pub fn check(&self) -> Result<(), String> {
        if self.bias.is_nan() || self.bias.abs() > MAX_WEIGHT {
            return Err(format!("bias is {:?}, must be -1e9 to 1e9", self.bias));
        }
        if let Some(weight) = self.weights.iter().find(|weight| !(0.0..=MAX_WEIGHT).contains(*weight)) {
            return Err(format!("a weight is {weight:?}, must be 0 to 1e9"));
        }
        if !(0.0..=1.0).contains(&self.withhold_below) {
            return Err(format!("withhold_below is {}, must be 0 to 1", self.withhold_below));
        }
        self.sigma.check()
    }

    /// Sigma of a pose, 0..=1.
    #[must_use]
    pub fn sigma(&self, evidence: &PoseEvidence) -> f64 {
        self.sigma.at(self.log_error(evidence)).clamp(0.0, 1.0)
    }

    /// Expected natural logarithm of the error in metres.
    fn log_error(&self, evidence: &PoseEvidence) -> f64 {
        self.bias + features(evidence).iter().zip(&self.weights).map(|(feature, weight)| feature * weight).sum::<f64>()
    }

    /// Model with round numbers, for tests.
    #[must_use]
    pub fn example() -> Self {
        let sigma = MonotoneMap::falling(vec![(-3.0, 0.95), (0.0, 0.5), (2.0, 0.05)]);
        Self { bias: -1.0, weights: [0.3; FEATURES], sigma, withhold_below: 0.1 }
    }
}

/// What speaks against a pose, each the larger the worse: logarithms, because errors span orders of magnitude.
fn features(evidence: &PoseEvidence) -> [f64; FEATURES] {
    let log = |value: f64| value.clamp(1e-3, 1e6).ln();
    // A head has a refiner or has none: features that are always 0 get no weight.
    let again =
        |value: fn(&RefinementEvidence) -> f64| evidence.second.as_ref().map_or(0.0, |second| log(value(second)));
    [
        -log(evidence.inlier_ratio),
        -log(evidence.inliers as f64 / 100.0),
        log(evidence.rms_m),
        log(evidence.inlier_epsilon_m),
        log(evidence.median_epsilon_m),
        log(evidence.position_std_m),
        log(evidence.rotation_std_rad),
        -again(|second| second.inlier_ratio),
        again(|second| second.rms_m),
        again(|second| second.median_epsilon_m),
        again(|second| second.moved_m),
        again(|second| second.residual_quartile_m),
        -again(|second| second.information_per_m2),
        again(|second| second.worst_axis_std_m),
    ]
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::pgc::pose_solver::PoseSolver;
    use crate::pgc::synthetic::SyntheticScene;

    #[test]
    fn sigma_falls_with_what_speaks_against_a_pose() {
        let sigma = |outliers, noise_m| {
            let town = SyntheticScene { outliers, noise_m, ..SyntheticScene::default() };
            let found = PoseSolver::default().solve(&town.coordinates(1)).unwrap();
            ConfidenceModel::example().sigma(&found.evidence)
        };
        let falling = [sigma(0.1, 0.1), sigma(0.3, 0.2), sigma(0.6, 0.4), sigma(0.8, 0.6)];
        assert!(falling.windows(2).all(|pair| pair[0] > pair[1]), "{falling:?}");
    }

    #[test]
    fn a_model_survives_its_file() {
        let model = ConfidenceModel::example();
        let text = serde_json::to_string(&model).unwrap();
        assert_eq!(serde_json::from_str::<ConfidenceModel>(&text).unwrap(), model);
        assert!(serde_json::from_str::<ConfidenceModel>(&text.replace("bias", "bais")).is_err());
    }

    #[test]
    fn numbers_that_no_fit_has_are_refused_by_name() {
        let example = ConfidenceModel::example;
        assert_eq!(example().check(), Ok(()));
        let refused = |model: ConfidenceModel, field: &str| model.check().unwrap_err().contains(field);
        let mut weights = [0.3; FEATURES];
        weights[3] = 1e308;
        assert!(refused(ConfidenceModel { weights, ..example() }, "a weight is 1e308"));
        weights[3] = -0.1;
        assert!(refused(ConfidenceModel { weights, ..example() }, "-0.1"));
        assert!(refused(ConfidenceModel { bias: f64::NAN, ..example() }, "bias is NaN"));
        assert!(refused(ConfidenceModel { withhold_below: 1.5, ..example() }, "withhold_below is 1.5"));
        for knots in [vec![(1.0, 0.5), (0.0, 0.4)], vec![(0.0, 0.4), (1.0, 0.5)], vec![(0.0, 2.0)]] {
            assert!(refused(ConfidenceModel { sigma: MonotoneMap::falling(knots), ..example() }, "sigma has"));
        }
    }

    #[test]
    fn the_plain_confidence_withholds_nothing() {
        assert!(!Confidence::Plain.withholds(0.0));
        assert!(Confidence::Calibrated(ConfidenceModel::example()).withholds(0.09));
    }
}
