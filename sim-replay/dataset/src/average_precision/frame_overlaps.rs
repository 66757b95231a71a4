//! Overlaps of a frame: its detections within the ground-truth range against its objects, and the verdicts at a
//! threshold.

use protocol::rotated_iou::Polygon;
use protocol::{Box3d, Detection, corners_within};

use super::Verdict;
use super::breakdown::PartMembers;
use crate::ground_truth::{GroundTruth, TrueBox};

/// Detections that may count, by falling score, with their overlaps.
pub(super) struct FrameOverlaps {
    /// Number of detections, those beyond the range included.
    detections: usize,
    pub(super) by_score: Vec<ScoredCandidate>,
}

/// A detection within the range.
pub(super) struct ScoredCandidate {
    /// Index among the detections of the frame.
    pub(super) index: usize,
    pub(super) score: f32,
    /// Overlap with each object that counts, single precision as in the reference.
    overlaps: Vec<f32>,
    /// Largest overlap with an object of a class that does not count.
    ignored_overlap: f32,
}

impl FrameOverlaps {
    /// Overlaps of the detections whose corners all lie in the range, by falling score. The sort is stable: equal scores
    /// stay in the order of the detector.
    pub(super) fn new(detections: &[Detection], truth: &GroundTruth) -> Self {
        let within = detections
            .iter()
            .enumerate()
            .filter(|(_, found)| corners_within(&found.box3d.corners(), truth.area_m));
        let (objects, ignored) = (footprints(&truth.objects), footprints(&truth.ignored));
        let candidates = within.map(|(index, found)| {
            let footprint = footprint(&found.box3d);
            ScoredCandidate {
                index,
                score: found.score,
                overlaps: overlaps(&footprint, &objects).collect(),
                ignored_overlap: overlaps(&footprint, &ignored).fold(0.0, f32::max),
            }
        });
        let mut by_score: Vec<ScoredCandidate> = candidates.collect();
        by_score.sort_by(|a, b| b.score.total_cmp(&a.score));
        Self {
            detections: detections.len(),
            by_score,
        }
    }

    /// Verdicts on all detections, in their order, for a part of the objects.
    pub(super) fn judge(&self, part: &PartMembers, iou_threshold: f64) -> Vec<Verdict> {
        let threshold = iou_threshold as f32;
        // Detections beyond the range are no candidates, so they keep this verdict.
        let mut verdicts = vec![Verdict::Ignored; self.detections];
        // Objects outside of the part count as taken: nothing matches them.
        let mut taken: Vec<bool> = part.objects.iter().map(|is_in| !is_in).collect();
        for candidate in &self.by_score {
            let overlaps = candidate.overlaps.iter().zip(&part.objects);
            let is_on_other = candidate.ignored_overlap >= threshold || { overlaps }
                .any(|(overlap, is_in)| !is_in && *overlap >= threshold);
            verdicts[candidate.index] = match take_best(&candidate.overlaps, &mut taken, threshold)
            {
                // A match wins: only a detection without one may be excused by another object.
                Some(object) => Verdict::Match(object),
                None if is_on_other || !part.detections[candidate.index] => Verdict::Ignored,
                None => Verdict::FalsePositive,
            };
        }
        verdicts
    }
}

fn overlaps(found: &Polygon, objects: &[Polygon]) -> impl Iterator<Item = f32> {
    objects.iter().map(|object| found.iou(object) as f32)
}

fn footprints(objects: &[TrueBox]) -> Vec<Polygon> {
    let boxes = objects.iter().map(|object| &object.box3d);
    boxes.map(footprint).collect()
}

fn footprint(box3d: &Box3d) -> Polygon {
    Polygon::footprint(&box3d.corners())
}

/// Takes the free object with the highest overlap, the first of equals, if it reaches the threshold.
fn take_best(overlaps: &[f32], taken: &mut [bool], threshold: f32) -> Option<usize> {
    let mut best = None;
    for (index, &overlap) in overlaps.iter().enumerate() {
        if !taken[index] && best.is_none_or(|(_, highest)| overlap > highest) {
            best = Some((index, overlap));
        }
    }
    // The best free object decides, as in the reference: it is not taken below the threshold.
    let (index, _) = best.filter(|(_, overlap)| *overlap >= threshold)?;
    taken[index] = true;
    Some(index)
}
