//! Training curve: CSV with one row per report, with AP where a validation was made; and a picture.

use csv::StringRecord;
use figures::{self, Axis, Chart, Mark, Series};
use perception::train::{Curve, Trainer};
use support::bounded_file::{self, MAX_TEXT_BYTES};
use support::csv_file;
use support::file_error::{AtFile, Result};

use super::validation::Accuracy;
use crate::Error;

const HEADER: &str = "step,epoch,seconds,learning_rate,loss,score_loss,box_loss,samples_per_second,waiting,ap_30,ap_50,ap_70";
/// Points of a line in the picture: losses of single batches are noisy and are averaged to about this number.
const SMOOTH_POINTS: usize = 150;

/// Report over some steps.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct TrainingReport {
    /// Steps done.
    pub(super) step: u64,
    /// Passes over the data.
    pub(super) epoch: f64,
    /// Seconds spent so far, in all runs together.
    pub(super) seconds: f64,
    /// Learning rate.
    pub(super) learning_rate: f64,
    /// Classification term.
    pub(super) score_loss: f64,
    /// Regression term.
    pub(super) box_loss: f64,
    /// Samples per second since the last report.
    pub(super) samples_per_second: f64,
    /// Share of that time spent waiting for samples, 0..1.
    pub(super) waiting: f64,
}

/// Rows of reports and validations.
#[derive(Debug)]
pub(super) struct DetectorCurve(Curve);

impl DetectorCurve {
    pub(super) fn open(trainer: &Trainer) -> Result<Self> {
        Ok(Self(trainer.curve(HEADER)?))
    }

    pub(super) fn step(&mut self, report: &TrainingReport) -> Result<()> {
        let (score_loss, box_loss) = (report.score_loss, report.box_loss);
        self.0.row(&format!(
            "{},{:.3},{:.1},{:.3e},{:.5},{score_loss:.5},{box_loss:.5},{:.2},{:.3},,,",
            report.step,
            report.epoch,
            report.seconds,
            report.learning_rate,
            score_loss + box_loss,
            report.samples_per_second,
            report.waiting
        ))
    }

    pub(super) fn validation(
        &mut self,
        step: u64,
        seconds: f64,
        accuracy: &Accuracy,
    ) -> Result<()> {
        let aps = accuracy.ap_global;
        let [ap_30, ap_50, ap_70] = aps.map(|ap| ap.map_or(String::new(), |ap| format!("{ap:.4}")));
        self.0.row(&format!(
            "{step},,{seconds:.1},,,,,,,{ap_30},{ap_50},{ap_70}"
        ))
    }

    /// Draws the curve so far, including rows of an interrupted training, into a PNG file beside it.
    pub(super) fn draw(&self, title: &str) -> Result<(), Error> {
        let path = self.0.path();
        let text = bounded_file::read_text(path, MAX_TEXT_BYTES).at(path)?;
        let picture = path.with_extension("png");
        Ok(figures::save_png(&charts(title, &text), &picture)?)
    }
}

fn charts(title: &str, csv: &str) -> Vec<Chart> {
    let losses = [
        ("sum", "loss"),
        ("classes", "score_loss"),
        ("boxes", "box_loss"),
    ];
    let losses = losses.map(|(name, column)| Series {
        name: name.into(),
        points: smooth(&column_over_steps(csv, column)),
        mark: Mark::Line,
    });
    let accuracies = [("0.3", "ap_30"), ("0.5", "ap_50"), ("0.7", "ap_70")];
    let accuracies = accuracies.map(|(name, column)| Series {
        name: name.into(),
        points: column_over_steps(csv, column),
        mark: Mark::LineAndDots,
    });
    let steps = column_over_steps(csv, "step");
    let steps = steps.iter().map(|point| point.1).fold(1.0, f64::max);
    let points = losses.iter().flat_map(|series| &series.points);
    let most = points.map(|point| point.1).fold(0.1, f64::max);
    let mut charts = vec![(Axis::linear("loss", [0.0, most]), losses)];
    if accuracies.iter().any(|series| !series.points.is_empty()) {
        let axis = Axis::linear("validation AP at IoU", [0.0, 1.0]);
        charts.push((axis, accuracies));
    }
    let charts = charts.into_iter().map(|(y, series)| Chart {
        title: title.into(),
        x: Axis::linear("step", [0.0, steps]),
        y,
        series: series.into(),
    });
    charts.collect()
}

/// Step and value of all rows that have one in `column`.
fn column_over_steps(csv: &str, column: &str) -> Vec<(f64, f64)> {
    let Some(place) = HEADER.split(',').position(|name| name == column) else {
        return Vec::new();
    };
    // A row that was truncated by the end of a process has no such column.
    csv_file::records(csv)
        .filter_map(|(_, row)| Some((number(&row, 0)?, number(&row, place)?)))
        .collect()
}

fn number(row: &StringRecord, place: usize) -> Option<f64> {
    row.get(place)?.parse().ok()
}

/// Means over so many neighbours that about [`SMOOTH_POINTS`] points are left.
fn smooth(points: &[(f64, f64)]) -> Vec<(f64, f64)> {
    let finite: Vec<_> = (points.iter().copied())
        .filter(|point| point.1.is_finite())
        .collect();
    let size = finite.len().div_ceil(SMOOTH_POINTS).max(1);
    let means = finite.chunks(size).map(|few| {
        let [x, y] = few.iter().fold([0.0; 2], |[x, y], p| [x + p.0, y + p.1]);
        (x / few.len() as f64, y / few.len() as f64)
    });
    means.collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn report(step: u64, score_loss: f64) -> TrainingReport {
        TrainingReport {
            step,
            epoch: 0.5,
            seconds: 3.0,
            learning_rate: 1e-3,
            score_loss,
            box_loss: 0.5,
            samples_per_second: 4.0,
            waiting: 0.0,
        }
    }

    #[test]
    fn the_picture_shows_what_the_file_holds_also_after_a_break() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("curve.csv");
        DetectorCurve(Curve::open(&path, HEADER, None).unwrap())
            .step(&report(10, 2.0))
            .unwrap();
        let mut curve = DetectorCurve(Curve::open(&path, HEADER, Some(10)).unwrap());
        curve.step(&report(20, f64::NAN)).unwrap();
        curve.step(&report(30, 1.0)).unwrap();
        curve
            .validation(
                30,
                4.0,
                &Accuracy {
                    frames: 5,
                    ap_global: [None, Some(0.5), Some(0.25)],
                    ap_frame_order: [None; 3],
                },
            )
            .unwrap();
        curve.draw("none").unwrap();
        assert!(
            std::fs::read(path.with_extension("png"))
                .unwrap()
                .starts_with(b"\x89PNG")
        );

        let drawn = charts("none", &std::fs::read_to_string(&path).unwrap());
        let [losses, accuracies] = &drawn[..] else {
            panic!("{drawn:?}")
        };
        assert_eq!(losses.series[0].points, [(10.0, 2.5), (30.0, 1.5)]);
        assert!(accuracies.series[0].points.is_empty(), "unknown");
        assert_eq!(accuracies.series[2].points, [(30.0, 0.25)]);
    }

    #[test]
    fn many_points_become_means_of_neighbours() {
        let points: Vec<(f64, f64)> = (0..600)
            .map(|step| (f64::from(step), f64::from(step % 2)))
            .collect();
        let smoothed = smooth(&points);
        assert_eq!((smoothed.len(), smoothed[1]), (150, (5.5, 0.5)));
        assert!(smooth(&[]).is_empty());
    }
}
