//! Report of a map: what the head was made of, how accurate it is, and where.

use localization::pgc::confidence::FitReport;
use perception::train::{RunConfig, Trained};
use serde::Serialize;

use super::coverage::Coverage;
use crate::evaluation::LocalizationSummary;

/// Mean error of a training cell above which a training was too short, metres: at the end of a sufficient one it is a few
/// metres.
const SHORT_TRAINING_M: f64 = 10.0;
/// Share of wrong poses that a confidence should reject.
const ENOUGH_REJECTED: f64 = 0.9;

/// A head for a place, and its measured accuracy.
#[derive(Debug, Clone, Serialize)]
pub struct PlaceReport {
    /// Name of the place.
    pub place: String,
    /// SHA-256 of the weights, confidence and scales included.
    pub sha256: String,
    /// Number of training sweeps.
    pub training_sweeps: usize,
    /// Encoded copies of each.
    pub copies: usize,
    /// Mean error of a training cell in the last steps, metres; `None` where a resumed training had none left.
    pub cell_error_m: Option<f64>,
    /// Accuracy on held-out sweeps; `None` if there were too few sweeps to hold any out.
    pub held_out: Option<HeldOutAccuracy>,
    /// Fit of the confidence; `None` if there were too few poses: then hardly any pose is rejected.
    pub confidence: Option<FitReport>,
    /// Number of activations with scales for 8-bit inference.
    pub activation_scales: usize,
    /// Area in which the training sweeps were recorded.
    pub coverage: Coverage,
    /// Sweeps and files that were left out.
    pub left_out: Option<String>,
    /// Seconds of the whole command.
    pub seconds: f64,
    /// Weights, steps and time of the training.
    #[serde(skip)]
    pub trained: Trained,
    /// Configuration of the training.
    #[serde(skip)]
    pub run: RunConfig,
}

/// Accuracy on sweeps that were not trained on.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct HeldOutAccuracy {
    /// Number of sweeps.
    pub sweeps: usize,
    /// Share with a pose less than 3 m off, 0..=1.
    pub under_3m: f64,
    /// Share with a pose less than 1 m off, 0..=1.
    pub under_1m: f64,
    /// Median distance of published poses from the true ones, metres.
    pub median_m: Option<f64>,
    /// Median angle between them, degrees.
    pub median_deg: Option<f64>,
    /// Number of sweeps without a pose.
    pub no_pose: usize,
}

impl HeldOutAccuracy {
    pub(super) fn of(summary: &LocalizationSummary) -> Self {
        Self {
            sweeps: summary.sweeps,
            under_3m: summary.success_3m,
            under_1m: summary.success_1m,
            median_m: summary.p50_m,
            median_deg: summary.p50_deg,
            no_pose: summary.no_pose,
        }
    }

    /// One line.
    pub fn text(&self) -> String {
        let [median_m, median_deg] = [self.median_m, self.median_deg]
            .map(|value| value.map_or("-".into(), |value| format!("{value:.3}")));
        format!(
            "{:.1} % of {} held-out sweeps under 3 m, {:.1} % under 1 m, median {median_m} m and {median_deg} degrees, {} without a pose",
            100.0 * self.under_3m,
            self.sweeps,
            100.0 * self.under_1m,
            self.no_pose
        )
    }
}

impl PlaceReport {
    /// The driven area, in one line.
    pub fn coverage_text(&self) -> String {
        let coverage = &self.coverage;
        let ([x_low, y_low], [x_high, y_high]) = (coverage.low_m, coverage.high_m);
        let (sweeps, length_m, cell_m) = (coverage.sweeps, coverage.length_m, coverage.area.cell_m);
        format!(
            "{sweeps} sweeps along {length_m:.0} m, x {x_low:.0} to {x_high:.0} m, y {y_low:.0} to {y_high:.0} m, {} cells of {cell_m:.0} m (#; x to the right, y up)",
            coverage.area.cells.len()
        )
    }

    /// The training, in one line.
    pub fn training_text(&self) -> String {
        let copies = match self.copies {
            0 | 1 => String::new(),
            copies => format!(" in {copies} copies"),
        };
        let error = self.cell_error_m;
        let error = error.map(|error_m| format!(", error of cells {error_m:.1} m"));
        let (sweeps, steps) = (self.training_sweeps, self.trained.steps);
        let error = error.unwrap_or_default();
        format!("{sweeps} sweeps{copies}, {steps} steps{error}")
    }

    /// The limits of the head, in sentences.
    pub fn limits_text(&self) -> String {
        let roads = "Roads that were not driven give no pose: drive every road, and both directions of wide ones.";
        let error_m = self.cell_error_m;
        let error_m = error_m.filter(|error_m| *error_m > SHORT_TRAINING_M);
        let training = error_m.map(|error_m| {
            format!("The training was too short, the cells of its own sweeps are {error_m:.0} m off: more --minutes.")
        });
        let limits = [training, self.confidence_limit()];
        let limits = limits.into_iter().flatten();
        limits.fold(roads.to_owned(), |text, limit| text + " " + &limit)
    }

    fn confidence_limit(&self) -> Option<String> {
        match (&self.held_out, &self.confidence) {
            (Some(_), Some(report)) => {
                let (bad, bad_rejected) = (report.bad, report.bad_rejected);
                let is_enough = bad_rejected as f64 >= ENOUGH_REJECTED * bad as f64;
                (!is_enough).then(|| {
                    format!(
                        "Its confidence rejects only {bad_rejected} of {bad} wrong poses: others are given out, mostly with low confidence."
                    )
                })
            }
            (Some(_), None) => Some(
                "Its confidence is not fitted: too few poses; wrong poses may be given out.".into(),
            ),
            (None, _) => Some(
                "Its accuracy is not measured: there were too few sweeps to hold any out.".into(),
            ),
        }
    }
}
