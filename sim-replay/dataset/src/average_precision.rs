//! Average precision of boxes in the plane, in both orderings that the field reports.
//!
//! Matching as in OpenCOOD: detections of a frame by falling score, each takes the remaining object with the highest
//! overlap of the rotated footprints; below the threshold it is a false positive, otherwise a true positive, and the
//! object is gone. AP is the area under the interpolated curve over all points (VOC 2010).
//!
//! The two orderings of the concatenated list differ by many percentage points, so a number without its ordering is of
//! little use: [`Ordering::Global`] sorts by score over all frames; [`Ordering::Frame`] keeps the frames one after
//! another (the default of OpenCOOD).
//!
//! ```
//! use protocol::{Box3d, Detection};
//! use dataset::average_precision::{Ordering, Scorer};
//!
//! let car = Box3d { center_m: [10.0, 2.0, -1.0], size_m: [4.5, 1.9, 1.6], heading_rad: 0.1 };
//! let mut scorer = Scorer::new(&[0.5, 0.7]);
//! scorer.add(&[Detection { box3d: car, score: 0.9, source: None }], &[car]);
//! assert_eq!(scorer.average_precisions(Ordering::Global), [1.0, 1.0]);
//! ```

#![expect(
    clippy::cast_possible_truncation,
    clippy::indexing_slicing,
    reason = "overlaps are compared in f32; indices are of the lists that they were taken from"
)]

use protocol::rotated_iou::Polygon;
use protocol::{Box3d, Detection};

/// Overlaps at which AP is reported.
pub const THRESHOLDS: [f64; 3] = [0.3, 0.5, 0.7];

/// Order of the list of detections.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Ordering {
    /// By score over all frames.
    Global,
    /// Frame after frame, by score inside each.
    Frame,
}

/// A detection after matching.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Matched {
    /// Confidence of the detection.
    pub score: f32,
    /// True if it matched an object.
    pub is_true: bool,
}

/// Precision over recall, and the area under it.
#[derive(Debug, Clone, PartialEq)]
pub struct Curve {
    /// Average precision, 0..1; 0 without objects.
    pub average_precision: f64,
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
    /// An empty tally.
    #[must_use]
    pub fn new(iou_threshold: f64) -> Self {
        Self {
            iou_threshold,
            matched: Vec::new(),
            objects: 0,
        }
    }

    /// The curve of everything matched so far.
    #[must_use]
    pub fn curve(&self, ordering: Ordering) -> Curve {
        let mut order: Vec<&Matched> = self.matched.iter().collect();
        if ordering == Ordering::Global {
            order.sort_by(|a, b| b.score.total_cmp(&a.score));
        }
        let mut recall = vec![0.0];
        let mut precision = vec![0.0];
        let mut found = 0usize;
        for (index, entry) in order.into_iter().enumerate() {
            found += usize::from(entry.is_true);
            recall.push(found as f64 / self.objects.max(1) as f64);
            precision.push(found as f64 / (index + 1) as f64);
        }
        recall.push(1.0);
        precision.push(0.0);
        for index in (1..precision.len()).rev() {
            precision[index - 1] = precision[index - 1].max(precision[index]);
        }
        let steps = recall.windows(2).zip(&precision[1..]);
        let average_precision = steps
            .map(|(recall, precision)| (recall[1] - recall[0]) * precision)
            .sum();
        Curve {
            average_precision,
            recall,
            precision,
        }
    }
}

/// Tallies of one evaluation at several thresholds; overlaps are computed once per frame.
#[derive(Debug, Clone, PartialEq)]
pub struct Scorer {
    tallies: Vec<Tally>,
}

impl Default for Scorer {
    fn default() -> Self {
        Self::new(&THRESHOLDS)
    }
}

impl Scorer {
    /// A scorer at the given overlaps.
    #[must_use]
    pub fn new(thresholds: &[f64]) -> Self {
        Self {
            tallies: thresholds.iter().copied().map(Tally::new).collect(),
        }
    }

    /// Adds a frame of detections and true boxes.
    pub fn add(&mut self, detections: &[Detection], objects: &[Box3d]) {
        let scored: Vec<_> = detections
            .iter()
            .map(|found| (footprint(&found.box3d), found.score))
            .collect();
        let objects: Vec<_> = objects.iter().map(footprint).collect();
        self.add_footprints(&scored, &objects);
    }

    /// Adds a frame given as footprints.
    pub fn add_footprints(&mut self, detections: &[(Polygon, f32)], objects: &[Polygon]) {
        let mut order: Vec<&(Polygon, f32)> = detections.iter().collect();
        // A stable sort: equal scores stay in the order of the detector.
        order.sort_by(|a, b| b.1.total_cmp(&a.1));
        let overlaps: Vec<Vec<f32>> = order
            .iter()
            .map(|(found, _)| overlaps(found, objects))
            .collect();
        for tally in &mut self.tallies {
            let mut taken = vec![false; objects.len()];
            for ((_, score), overlaps) in order.iter().zip(&overlaps) {
                let is_true = take_best(overlaps, &mut taken, tally.iou_threshold).is_some();
                tally.matched.push(Matched {
                    score: *score,
                    is_true,
                });
            }
            tally.objects += objects.len();
        }
    }

    /// The tallies, one per threshold.
    #[must_use]
    pub fn tallies(&self) -> &[Tally] {
        &self.tallies
    }

    /// AP at every threshold, in their order.
    #[must_use]
    pub fn average_precisions(&self, ordering: Ordering) -> Vec<f64> {
        self.tallies
            .iter()
            .map(|tally| tally.curve(ordering).average_precision)
            .collect()
    }
}

fn footprint(box3d: &Box3d) -> Polygon {
    Polygon::footprint(&box3d.corners())
}

/// Overlap with every object, single precision as in the reference.
fn overlaps(found: &Polygon, objects: &[Polygon]) -> Vec<f32> {
    objects
        .iter()
        .map(|object| found.iou(object) as f32)
        .collect()
}

/// For each detection of a frame the index of the object that it matches at an overlap, as [`Scorer`] counts them.
#[must_use]
pub fn matches(
    detections: &[Detection],
    objects: &[Box3d],
    iou_threshold: f64,
) -> Vec<Option<usize>> {
    let objects: Vec<_> = objects.iter().map(footprint).collect();
    let mut order: Vec<usize> = (0..detections.len()).collect();
    order.sort_by(|&a, &b| detections[b].score.total_cmp(&detections[a].score));
    let (mut taken, mut matched) = (vec![false; objects.len()], vec![None; detections.len()]);
    for index in order {
        let overlaps = overlaps(&footprint(&detections[index].box3d), &objects);
        matched[index] = take_best(&overlaps, &mut taken, iou_threshold);
    }
    matched
}

/// Takes the free object with the highest overlap, the first of equals, if it reaches the threshold.
fn take_best(overlaps: &[f32], taken: &mut [bool], threshold: f64) -> Option<usize> {
    let mut best = None;
    for (index, &overlap) in overlaps.iter().enumerate() {
        if !taken[index] && best.is_none_or(|(_, highest)| overlap > highest) {
            best = Some((index, overlap));
        }
    }
    match best {
        Some((index, overlap)) if overlap >= threshold as f32 => {
            taken[index] = true;
            Some(index)
        }
        _ => None,
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn car(x: f64) -> Box3d {
        Box3d {
            center_m: [x, 0.0, 0.0],
            size_m: [4.0, 2.0, 1.5],
            heading_rad: 0.0,
        }
    }

    fn found(x: f64, score: f32) -> Detection {
        Detection {
            box3d: car(x),
            score,
            source: None,
        }
    }

    #[test]
    fn matches_are_those_that_are_counted() {
        let detections = [
            found(0.3, 0.4),
            found(0.1, 0.9),
            found(30.0, 0.8),
            found(10.0, 0.2),
        ];
        let objects = [car(10.0), car(0.0)];
        assert_eq!(
            matches(&detections, &objects, 0.5),
            [None, Some(1), None, Some(0)]
        );
        let mut scorer = Scorer::new(&[0.5]);
        scorer.add(&detections, &objects);
        assert_eq!(
            scorer.tallies()[0]
                .matched
                .iter()
                .filter(|matched| matched.is_true)
                .count(),
            2
        );
    }

    #[test]
    fn perfect_boxes_have_ap_one() {
        let mut scorer = Scorer::default();
        scorer.add(&[found(0.0, 0.9), found(10.0, 0.8)], &[car(10.0), car(0.0)]);
        for ordering in [Ordering::Global, Ordering::Frame] {
            assert_eq!(scorer.average_precisions(ordering), [1.0, 1.0, 1.0]);
        }
    }

    #[test]
    fn a_second_box_on_one_object_is_false() {
        let mut scorer = Scorer::new(&[0.5]);
        scorer.add(&[found(0.1, 0.8), found(0.0, 0.9)], &[car(0.0)]);
        let is_true: Vec<bool> = scorer.tallies()[0]
            .matched
            .iter()
            .map(|entry| entry.is_true)
            .collect();
        assert_eq!(is_true, [true, false]);
    }

    #[test]
    fn the_loser_of_the_best_object_may_still_find_another() {
        let mut scorer = Scorer::new(&[0.3]);
        // Both detections overlap the first object most; the second takes the other one.
        scorer.add(&[found(0.0, 0.9), found(0.6, 0.8)], &[car(0.2), car(2.0)]);
        assert!(
            scorer.tallies()[0]
                .matched
                .iter()
                .all(|entry| entry.is_true)
        );
    }

    #[test]
    fn frames_without_detections_still_count_their_objects() {
        let mut scorer = Scorer::new(&[0.5]);
        scorer.add(&[found(0.0, 0.9)], &[car(0.0)]);
        scorer.add(&[], &[car(0.0)]);
        assert_eq!(scorer.average_precisions(Ordering::Global), [0.5]);
    }

    #[test]
    fn orderings_differ_where_a_bad_frame_comes_first() {
        let mut scorer = Scorer::new(&[0.5]);
        scorer.add(&[found(50.0, 0.2)], &[]);
        scorer.add(&[found(0.0, 0.9)], &[car(0.0)]);
        assert_eq!(scorer.average_precisions(Ordering::Global), [1.0]);
        assert_eq!(scorer.average_precisions(Ordering::Frame), [0.5]);
    }

    #[test]
    fn nothing_to_find_is_zero_and_not_a_crash() {
        let mut scorer = Scorer::default();
        assert_eq!(scorer.average_precisions(Ordering::Global), [0.0; 3]);
        scorer.add(&[found(0.0, 0.9)], &[]);
        assert_eq!(scorer.average_precisions(Ordering::Global), [0.0; 3]);
    }

    proptest! {
        #[test]
        fn ap_lies_between_zero_and_one_and_reading_changes_nothing(
            offsets in prop::collection::vec((-30.0..30.0f64, 0.0..1.0f32), 0..20),
            objects in prop::collection::vec(-30.0..30.0f64, 0..10),
        ) {
            let mut scorer = Scorer::default();
            let detections: Vec<_> = offsets.iter().map(|&(x, score)| found(x, score)).collect();
            let objects: Vec<_> = objects.into_iter().map(car).collect();
            scorer.add(&detections, &objects);
            for ordering in [Ordering::Global, Ordering::Frame] {
                let first = scorer.average_precisions(ordering);
                prop_assert!(first.iter().all(|ap| (0.0..=1.0).contains(ap)));
                prop_assert_eq!(&first, &scorer.average_precisions(ordering));
                prop_assert!(first.windows(2).all(|pair| pair[0] >= pair[1] || objects.len() > 1));
            }
        }
    }
}
