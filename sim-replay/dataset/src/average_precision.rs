//! Average precision of boxes in the plane, in both orderings that the field reports.
//!
//! Matching as in OpenCOOD: detections of a frame by falling score, each takes the remaining object with the highest
//! overlap of the rotated footprints; below the threshold it is a false positive, otherwise a true positive, and the
//! object is gone. AP is the area under the interpolated curve over all points (VOC 2010).
//!
//! The rule of the ground truth holds for both sides. A detection with a corner beyond the ground-truth range does not
//! count, as in OpenCOOD's post-processor (`get_mask_for_boxes_within_range_torch`, x and y). One that overlaps an
//! object of a class that does not count, at the same threshold, counts neither way, as KITTI treats neighbouring
//! classes.
//!
//! The two orderings of the concatenated list differ by many percentage points, so a number without its ordering is of
//! little use: [`Ordering::Global`] sorts by score over all frames; [`Ordering::Frame`] keeps the frames one after
//! another (the default of OpenCOOD).
//!
//! ```
//! use protocol::{Box3d, Detection};
//! use dataset::average_precision::{Ordering, Scorer};
//! use dataset::ground_truth::GroundTruth;
//!
//! let car = Box3d { center_m: [10.0, 2.0, -1.0], size_m: [4.5, 1.9, 1.6], heading_rad: 0.1 };
//! let mut scorer = Scorer::new(&[0.5, 0.7]);
//! scorer.add(&[Detection { box3d: car, score: 0.9, source: None }], &GroundTruth::of_boxes([car]));
//! assert_eq!(scorer.average_precisions(Ordering::Global), [Some(1.0), Some(1.0)]);
//! ```

#![expect(
    clippy::cast_possible_truncation,
    clippy::indexing_slicing,
    reason = "overlaps are compared in f32; indices are of the lists that they were taken from"
)]

mod breakdown;
mod frame_overlaps;

use protocol::Detection;

use crate::ground_truth::GroundTruth;
use breakdown::PartMembers;
use frame_overlaps::FrameOverlaps;

pub use crate::evaluation_protocol::ApOrder as Ordering;
pub use breakdown::Breakdown;

/// Overlaps at which AP is reported.
pub const THRESHOLDS: [f64; 3] = [0.3, 0.5, 0.7];

/// Judgement of a detection at an overlap.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Verdict {
    /// True positive: it matches the object of this index in [`GroundTruth::objects`].
    Match(usize),
    /// False positive.
    FalsePositive,
    /// It counts neither way: beyond the range, or on an object that does not count.
    Ignored,
}

/// A detection that counts, after matching.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Matched {
    /// Confidence of the detection.
    pub score: f32,
    /// True if it matched an object.
    pub is_true: bool,
}

/// Precision over recall, and the area under it.
#[derive(Debug, Clone, PartialEq)]
pub struct PrecisionRecallCurve {
    /// Average precision, 0..1; unknown without objects.
    pub average_precision: Option<f64>,
    /// Recall after each detection, with 0 in front and 1 at the end.
    pub recall: Vec<f64>,
    /// Precision at each of `recall`, made non-increasing from the right, with a 0 at the end.
    pub precision: Vec<f64>,
}

/// Detections matched at one threshold, frame after frame.
#[derive(Debug, Clone, PartialEq)]
pub struct Tally {
    /// Overlap from which a detection counts.
    pub iou_threshold: f64,
    /// Detections in the order of frames, by falling score inside each.
    pub matched: Vec<Matched>,
    /// Objects over all frames.
    pub objects: usize,
}

impl Tally {
    /// Adds a frame; returns the verdicts in the order of its detections.
    fn add(&mut self, frame: &FrameOverlaps, part: &PartMembers) -> Vec<Verdict> {
        let verdicts = frame.judge(part, self.iou_threshold);
        for candidate in &frame.by_score {
            let verdict = verdicts[candidate.index];
            if verdict != Verdict::Ignored {
                self.matched.push(Matched {
                    score: candidate.score,
                    is_true: verdict != Verdict::FalsePositive,
                });
            }
        }
        self.objects += part.objects.iter().filter(|is_in| **is_in).count();
        verdicts
    }

    /// The curve of everything matched so far.
    pub fn curve(&self, ordering: Ordering) -> PrecisionRecallCurve {
        let mut order: Vec<&Matched> = self.matched.iter().collect();
        if ordering == Ordering::Global {
            // A stable sort: equal scores stay in the order of the frames.
            order.sort_by(|a, b| b.score.total_cmp(&a.score));
        }
        let mut recall = vec![0.0];
        let mut precision = vec![0.0];
        let mut found = 0usize;
        for (index, entry) in order.into_iter().enumerate() {
            found += usize::from(entry.is_true);
            // Without objects nothing is found: a recall of 0 / 1 instead of NaN.
            recall.push(found as f64 / self.objects.max(1) as f64);
            precision.push(found as f64 / (index + 1) as f64);
        }
        recall.push(1.0);
        precision.push(0.0);
        // Step: the envelope, from the right: no recall has a lower precision than a larger one.
        for index in (1..precision.len()).rev() {
            precision[index - 1] = precision[index - 1].max(precision[index]);
        }
        // Step: the area under it. Where recall does not rise the width is 0.
        let steps = recall.windows(2).zip(&precision[1..]);
        let widths = steps.map(|(recall, precision)| (recall[1] - recall[0]) * precision);
        PrecisionRecallCurve {
            average_precision: (self.objects > 0).then(|| widths.sum()),
            recall,
            precision,
        }
    }
}

/// Tallies of one evaluation at several thresholds, for all objects and for parts of them; overlaps are computed once
/// per frame.
#[derive(Debug, Clone, PartialEq)]
pub struct Scorer {
    /// Of all objects, one per threshold.
    pub tallies: Vec<Tally>,
    /// Of parts of the objects, one per threshold.
    pub parts: Vec<(Breakdown, Vec<Tally>)>,
}

impl Default for Scorer {
    fn default() -> Self {
        Self::new(&THRESHOLDS)
    }
}

impl Scorer {
    /// A scorer at the given overlaps.
    pub fn new(thresholds: &[f64]) -> Self {
        let tallies = thresholds.iter().map(|&iou_threshold| Tally {
            iou_threshold,
            matched: Vec::new(),
            objects: 0,
        });
        Self {
            tallies: tallies.collect(),
            parts: Vec::new(),
        }
    }

    /// The same with tallies by distance and by class.
    #[must_use]
    pub fn with_breakdowns(self) -> Self {
        let parts = Breakdown::parts().map(|part| (part, self.tallies.clone()));
        Self {
            parts: parts.collect(),
            ..self
        }
    }

    /// Adds a frame: judges its detections at every threshold.
    ///
    /// Returns the verdicts at each threshold, in the order of the detections.
    pub fn add(&mut self, detections: &[Detection], truth: &GroundTruth) -> Vec<Vec<Verdict>> {
        let frame = FrameOverlaps::new(detections, truth);
        for (part, tallies) in &mut self.parts {
            let part = part.selection(detections, truth);
            tallies.iter_mut().for_each(|tally| {
                tally.add(&frame, &part);
            });
        }
        let all = PartMembers {
            objects: vec![true; truth.objects.len()],
            detections: vec![true; detections.len()],
        };
        self.tallies
            .iter_mut()
            .map(|tally| tally.add(&frame, &all))
            .collect()
    }

    /// AP at every threshold, in their order; unknown without objects.
    pub fn average_precisions(&self, ordering: Ordering) -> Vec<Option<f64>> {
        self.tallies
            .iter()
            .map(|tally| tally.curve(ordering).average_precision)
            .collect()
    }
}

#[cfg(test)]
mod tests;
