//! Average precision and hits of a scorer.

use std::collections::BTreeMap;

use dataset::average_precision::{Breakdown, Ordering, Scorer, Tally, Verdict};
use support::csv_file::CsvText;

use crate::score::metrics::{ByIou, PartPrecision};

/// IoU from which a detection counts as found in `frames.csv`.
const FOUND_IOU: f64 = 0.5;

/// AP at the three IoU thresholds; `None` without a true object.
pub(super) fn by_iou(tallies: &[Tally], ordering: Ordering) -> ByIou {
    let [at_30, at_50, at_70] = [0, 1, 2].map(|index: usize| {
        let tally = tallies.get(index)?;
        tally.curve(ordering).average_precision
    });
    ByIou {
        at_30,
        at_50,
        at_70,
    }
}

/// AP of the parts that have objects, ordered by score: of bins of distance, and of classes.
pub(super) fn by_part(scorer: &Scorer) -> [BTreeMap<String, PartPrecision>; 2] {
    let mut by_part = [BTreeMap::new(), BTreeMap::new()];
    let [distances, classes] = &mut by_part;
    for (part, tallies) in scorer.parts() {
        let objects = tallies.first().map_or(0, |tally| tally.objects);
        if objects > 0 {
            let precision = PartPrecision {
                objects,
                ap: by_iou(tallies, Ordering::Global),
            };
            match part {
                Breakdown::Distance(_) => distances.insert(part.to_string(), precision),
                Breakdown::Class(_) => classes.insert(part.to_string(), precision),
            };
        }
    }
    by_part
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

/// Detections of a frame at an IoU of 0.5.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub(super) struct FrameCounts {
    /// Detections that count.
    pub(super) detected: usize,
    /// Of these, those that match a true object.
    pub(super) found: usize,
}

impl FrameCounts {
    /// Counts of a frame that has just been added to `scorer`, with its verdicts.
    pub(super) fn of(scorer: &Scorer, verdicts: &[Vec<Verdict>]) -> Self {
        let mut counts = Self::default();
        let all = scorer.tallies().iter().zip(verdicts);
        // Compared exactly, as thresholds are constants and none is computed.
        let at_iou = all.filter(|(tally, _)| tally.iou_threshold == FOUND_IOU);
        for verdict in at_iou.flat_map(|(_, verdicts)| verdicts) {
            counts.detected += usize::from(*verdict != Verdict::Ignored);
            counts.found += usize::from(matches!(verdict, Verdict::Match(_)));
        }
        counts
    }
}
