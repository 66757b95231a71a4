//! Average precision and hits of a scorer.

use dataset::average_precision::{Ordering, Scorer, Tally, Verdict};
use dataset::ground_truth::GroundTruth;
use protocol::Detection;

use crate::score::metrics::ByIou;

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

/// Detections of a frame at an IoU of 0.5.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub(super) struct FrameCounts {
    /// Detections that count.
    pub(super) detected: usize,
    /// Of these, those that match a true object.
    pub(super) found: usize,
}

impl FrameCounts {
    /// Adds a frame to `scorer`, and counts it.
    pub(super) fn of(scorer: &mut Scorer, detections: &[Detection], truth: &GroundTruth) -> Self {
        let verdicts = scorer.add(detections, truth);
        let mut counts = Self::default();
        let all = scorer.tallies.iter().zip(&verdicts);
        // Compared exactly, as thresholds are constants and none is computed.
        let at_iou = all.filter(|(tally, _)| tally.iou_threshold == FOUND_IOU);
        for verdict in at_iou.flat_map(|(_, verdicts)| verdicts) {
            counts.detected += usize::from(*verdict != Verdict::Ignored);
            counts.found += usize::from(matches!(verdict, Verdict::Match(_)));
        }
        counts
    }
}
