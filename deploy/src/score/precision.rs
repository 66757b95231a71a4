//! Average precision and hits of a scorer.

use dataset::average_precision::{Ordering, Scorer};

use crate::score::metrics::ByIou;

/// IoU from which a detection counts as found in `frames.csv`.
const FOUND_IOU: f64 = 0.5;

/// AP at the three IoU thresholds; `None` without a true object.
pub(super) fn by_iou(scorer: &Scorer, ordering: Ordering) -> ByIou {
    let objects = scorer.tallies().first().map_or(0, |tally| tally.objects);
    match scorer.average_precisions(ordering)[..] {
        [at_30, at_50, at_70] if objects > 0 => ByIou { at_30: Some(at_30), at_50: Some(at_50), at_70: Some(at_70) },
        _ => ByIou::default(),
    }
}

/// Number of the last `detected` detections of a scorer that overlap a true box by at least [`FOUND_IOU`].
pub(super) fn found_by_last(scorer: &Scorer, detected: usize) -> usize {
    scorer.tallies().iter().find(|tally| tally.iou_threshold == FOUND_IOU).map_or(0, |tally| {
        let first = tally.matched.len().saturating_sub(detected);
        tally.matched[first..].iter().filter(|matched| matched.is_true).count()
    })
}
