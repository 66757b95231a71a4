//! Confidence of a pose: maps the evidence for the pose to one number, sigma.
//!
//! Sigma is calibrated if the poses with sigma `s` have errors `e` (metres) whose mean of `1 / (1 + e^2)` is `s`: Eq. 6
//! of the paper, which defines sigma for a cell, applied to a pose. Without calibration it is the mean of the inliers'
//! confidences times the inlier ratio.

mod fit;
mod isotonic;

use protocol::config::{FieldError, within};
use serde::{Deserialize, Serialize};

pub use fit::{BAD_M, FitError, FitReport, Labelled, Rejection, observed};
pub use isotonic::MonotoneMap;

use super::pose_evidence::{PoseEvidence, RefinementEvidence};

/// Number of features of [`PoseEvidence`].
const FEATURES: usize = 14;

/// Metadata key of a head's file that holds the [`ConfidenceModel`] of its scene, as JSON.
pub const CONFIDENCE_KEY: &str = "confidence";

/// Bound of weights and bias, far beyond those of any fit; it keeps sums of weighted features finite.
const MAX_WEIGHT: f64 = 1e9;

/// Computation of sigma.
#[derive(Debug, Clone, PartialEq, Default)]
pub enum Confidence {
    /// Mean confidence of the inliers times the inlier ratio; nothing is rejected.
    #[default]
    Plain,
    /// Fitted on sweeps with known poses.
    Calibrated(ConfidenceModel),
}

impl Confidence {
    /// Sigma of a pose, 0..=1.
    pub fn sigma(&self, evidence: &PoseEvidence) -> f64 {
        match self {
            Self::Plain => evidence.plain_sigma(),
            Self::Calibrated(model) => model.sigma(evidence),
        }
    }

    /// True if a pose of this sigma is rejected.
    pub fn rejects(&self, sigma: f64) -> bool {
        match self {
            Self::Plain => false,
            Self::Calibrated(model) => sigma < model.reject_below,
        }
    }
}

/// Sigma as a monotone function of a weighted sum of the evidence against a pose.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ConfidenceModel {
    /// Expected logarithm of the error in metres where all features are 0.
    pub bias: f64,
    /// Weight of each feature, none below 0: evidence against a pose never increases sigma, however far a sweep is from
    /// the fitted ones.
    pub weights: [f64; FEATURES],
    /// Decreasing function from the expected logarithm of the error to sigma.
    pub sigma: MonotoneMap,
    /// Threshold: poses of a lower sigma are rejected. Files and errors have its earlier name.
    #[serde(rename = "withhold_below")]
    pub reject_below: f64,
}

impl ConfidenceModel {
    /// Checks values from a file against the bounds of a fit.
    ///
    /// # Errors
    /// [`FieldError`] of the first field that is wrong.
    pub fn check(&self) -> Result<(), FieldError> {
        within("bias", self.bias, -MAX_WEIGHT, MAX_WEIGHT)?;
        for &weight in &self.weights {
            within("a weight", weight, 0.0, MAX_WEIGHT)?;
        }
        within("withhold_below", self.reject_below, 0.0, 1.0)?;
        self.sigma.check()
    }

    /// Sigma of a pose, 0..=1.
    pub fn sigma(&self, evidence: &PoseEvidence) -> f64 {
        self.sigma.at(self.log_error(evidence)).clamp(0.0, 1.0)
    }

    /// Expected natural logarithm of the error in metres.
    fn log_error(&self, evidence: &PoseEvidence) -> f64 {
        let features = features(evidence);
        let terms = features
            .iter()
            .zip(&self.weights)
            .map(|(feature, weight)| feature * weight);
        self.bias + terms.sum::<f64>()
    }

    /// Model with round numbers, for tests.
    pub fn example() -> Self {
        Self {
            bias: -1.0,
            weights: [0.3; FEATURES],
            sigma: MonotoneMap::falling(vec![(-3.0, 0.95), (0.0, 0.5), (2.0, 0.05)]),
            reject_below: 0.1,
        }
    }
}

fn log(value: f64) -> f64 {
    value.clamp(1e-3, 1e6).ln()
}

/// Feature of a refined pose. A head has a refiner or has none: features that are always 0 get no weight.
fn refinement(second: Option<&RefinementEvidence>, of: fn(&RefinementEvidence) -> f64) -> f64 {
    second.map_or(0.0, |second| log(of(second)))
}

/// Evidence against a pose, each feature the larger the worse: logarithms, because errors span orders of magnitude.
fn features(evidence: &PoseEvidence) -> [f64; FEATURES] {
    let second = evidence.second.as_ref();
    [
        -log(evidence.inlier_ratio),
        -log(evidence.inliers as f64 / 100.0),
        log(evidence.rms_m),
        log(evidence.inlier_epsilon_m),
        log(evidence.median_epsilon_m),
        log(evidence.position_std_m),
        log(evidence.rotation_std_rad),
        -refinement(second, |second| second.inlier_ratio),
        refinement(second, |second| second.rms_m),
        refinement(second, |second| second.median_epsilon_m),
        refinement(second, |second| second.moved_m),
        refinement(second, |second| second.residual_quartile_m),
        -refinement(second, |second| second.information_per_m2),
        refinement(second, |second| second.worst_axis_std_m),
    ]
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::pgc::pose_solver::PoseSolver;
    use crate::pgc::test_scene::SyntheticScene;

    #[test]
    fn sigma_decreases_with_evidence_against_a_pose() {
        let noisier = [(0.1, 0.1), (0.3, 0.2), (0.6, 0.4), (0.8, 0.6)];
        let falling = noisier.map(|(outliers, noise_m)| {
            let scene = SyntheticScene {
                outliers,
                noise_m,
                ..SyntheticScene::default()
            };
            let found = PoseSolver::default().solve(&scene.coordinates(1)).unwrap();
            ConfidenceModel::example().sigma(&found.evidence)
        });
        assert!(
            falling.windows(2).all(|pair| pair[0] > pair[1]),
            "{falling:?}"
        );
    }

    #[test]
    fn a_model_survives_its_file() {
        let model = ConfidenceModel::example();
        let text = serde_json::to_string(&model).unwrap();
        assert_eq!(
            serde_json::from_str::<ConfidenceModel>(&text).unwrap(),
            model
        );
        assert!(serde_json::from_str::<ConfidenceModel>(&text.replace("bias", "bais")).is_err());
    }

    fn is_refused_by_name(model: ConfidenceModel, field: &str) -> bool {
        model.check().unwrap_err().to_string().contains(field)
    }

    #[test]
    fn values_that_no_fit_has_are_rejected_by_name() {
        let example = ConfidenceModel::example;
        assert_eq!(example().check(), Ok(()));
        let mut weights = [0.3; FEATURES];
        weights[3] = 1e308;
        assert!(is_refused_by_name(
            ConfidenceModel {
                weights,
                ..example()
            },
            "a weight is 1000000"
        ));
        weights[3] = -0.1;
        assert!(is_refused_by_name(
            ConfidenceModel {
                weights,
                ..example()
            },
            "-0.1"
        ));
        assert!(is_refused_by_name(
            ConfidenceModel {
                bias: f64::NAN,
                ..example()
            },
            "bias is NaN"
        ));
        assert!(is_refused_by_name(
            ConfidenceModel {
                reject_below: 1.5,
                ..example()
            },
            "withhold_below is 1.5"
        ));
        for knots in [
            vec![(1.0, 0.5), (0.0, 0.4)],
            vec![(0.0, 0.4), (1.0, 0.5)],
            vec![(0.0, 2.0)],
        ] {
            assert!(is_refused_by_name(
                ConfidenceModel {
                    sigma: MonotoneMap::falling(knots),
                    ..example()
                },
                "of sigma"
            ));
        }
    }

    #[test]
    fn the_plain_confidence_rejects_nothing() {
        assert!(!Confidence::Plain.rejects(0.0));
        assert!(Confidence::Calibrated(ConfidenceModel::example()).rejects(0.09));
    }
}
