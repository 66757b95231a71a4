//! Report of a map: what the head was made of, how accurate it is, and where.

use localization::pgc::confidence::FitReport;
use perception::train::{RunConfig, Trained};
use serde::Serialize;

use super::coverage::Coverage;
use crate::evaluation::LocalizationSummary;

/// A head for a place, and its measured accuracy.
#[derive(Debug, Clone, Serialize)]
pub struct MapReport {
    /// Name of the place.
    pub place: String,
    /// SHA-256 of the weights, confidence and scales included.
    pub sha256: String,
    /// Number of training sweeps.
    pub training_sweeps: usize,
    /// Encoded copies of each.
    pub copies: usize,
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
        let &LocalizationSummary { sweeps, success_3m, success_1m, p50_m, p50_deg, no_pose, .. } = summary;
        Self { sweeps, under_3m: success_3m, under_1m: success_1m, median_m: p50_m, median_deg: p50_deg, no_pose }
    }

    /// One line.
    #[must_use]
    pub fn text(&self) -> String {
        let number = |value: Option<f64>, digits: usize| value.map_or("-".into(), |value| format!("{value:.digits$}"));
        format!(
            "{:.1} % of {} held-out sweeps under 3 m, {:.1} % under 1 m, median {} m and {} degrees, {} without a pose",
            100.0 * self.under_3m,
            self.sweeps,
            100.0 * self.under_1m,
            number(self.median_m, 3),
            number(self.median_deg, 3),
            self.no_pose
        )
    }
}

impl MapReport {
    /// The driven area, in one line.
    #[must_use]
    pub fn coverage_text(&self) -> String {
        let Coverage { sweeps, length_m, low_m, high_m, cells, cell_m, .. } = &self.coverage;
        format!(
            "{sweeps} sweeps along {length_m:.0} m, x {:.0} to {:.0} m, y {:.0} to {:.0} m, {} cells of {cell_m:.0} m",
            low_m[0],
            high_m[0],
            low_m[1],
            high_m[1],
            cells.len()
        )
    }

    /// The limits of the head, in sentences.
    #[must_use]
    pub fn limits_text(&self) -> String {
        let measured = match (&self.held_out, &self.confidence) {
            (Some(_), Some(_)) => "",
            (Some(_), None) => " Its confidence is not fitted: too few poses; wrong poses may be given out.",
            (None, _) => " Its accuracy is not measured: there were too few sweeps to hold any out.",
        };
        format!(
            "Roads that were not driven give no pose: drive every road, and both directions of wide ones.{measured}"
        )
    }
}
