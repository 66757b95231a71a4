//! Average precision and hits of a scorer.

use dataset::average_precision::{Ordering, Scorer};
use support::csv_file::CsvText;

use crate::score::metrics::ByIou;

/// IoU from which a detection counts as found in `frames.csv`.
const FOUND_IOU: f64 = 0.5;

/// AP at the three IoU thresholds; `None` without a true object.
pub(super) fn by_iou(scorer: &Scorer, ordering: Ordering) -> ByIou {
    let objects = scorer.tallies().first().map_or(0, |tally| tally.objects);
    match scorer.average_precisions(ordering)[..] {
        [at_30, at_50, at_70] if objects > 0 => ByIou {
            at_30: Some(at_30),
            at_50: Some(at_50),
            at_70: Some(at_70),
        },
        _ => ByIou::default(),
    }
}

/// Precision over recall, ordered by score: a row per detection.
pub(super) fn precision_recall_csv(scorer: &Scorer) -> String {
    let mut text = CsvText::new("iou,score,recall,precision");
    for tally in scorer.tallies() {
        let curve = tally.curve(Ordering::Global);
        let mut scores: Vec<f32> = tally.matched.iter().map(|matched| matched.score).collect();
        scores.sort_by(|a, b| b.total_cmp(a));
        // The curve has a point more at each end.
        let points = curve.recall.iter().zip(&curve.precision).skip(1);
        for (score, (recall, precision)) in scores.iter().zip(points) {
            let numbers =
                [f64::from(*score), *recall, *precision].map(|number| format!("{number:.6}"));
            text.row([tally.iou_threshold.to_string()].into_iter().chain(numbers));
        }
    }
    text.finish()
}

/// Number of the last `detected` detections of a scorer that overlap a true box by at least [`FOUND_IOU`].
pub(super) fn found_by_last(scorer: &Scorer, detected: usize) -> usize {
    scorer
        .tallies()
        .iter()
        .find(|tally| tally.iou_threshold == FOUND_IOU)
        .map_or(0, |tally| {
            let first = tally.matched.len().saturating_sub(detected);
            tally.matched[first..]
                .iter()
                .filter(|matched| matched.is_true)
                .count()
        })
}
