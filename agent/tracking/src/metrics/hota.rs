//! HOTA: detection and association accuracy, averaged over localisation thresholds.
//!
//! The similarity of an object and a track is `max(0, 1 - d / 2 m)` of their centre distance `d` in the plane, as in
//! Argoverse 2; not the IoU of boxes, as KITTI has it. Numbers of the two cannot be compared.

use std::collections::BTreeMap;

use nalgebra::DMatrix;

use super::MATCH_DISTANCE_M;
use super::sequence::{Lengths, Sequence, TrackedFrame};
use crate::assignment;

/// Number of thresholds: 0.05, 0.1, ..., 0.95.
const THRESHOLDS: usize = 19;

/// HOTA and its two factors, means over the thresholds.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Hota {
    /// Geometric mean of DetA and AssA at each threshold.
    pub hota: f64,
    /// Detection accuracy: matches over matches, misses and false positives.
    pub det_a: f64,
    /// Association accuracy: mean over matches of the Jaccard index of the two tracks.
    pub ass_a: f64,
}

/// Sums over sequences at one threshold.
#[derive(Debug, Clone, Copy, Default)]
struct Sums {
    matches: f64,
    unmatched: f64,
    association: f64,
}

/// Amount by pair of object and track.
type PairValues = BTreeMap<(i64, u64), f64>;

impl Hota {
    /// HOTA over all sequences; `None` without objects and tracks.
    pub fn of(sequences: &[Sequence]) -> Option<Self> {
        let mut sums = [Sums::default(); THRESHOLDS];
        for sequence in sequences {
            add(sequence, &mut sums);
        }
        let [first, ..] = sums;
        if first.matches + first.unmatched == 0.0 {
            return None;
        }
        Some(Self {
            hota: mean(&sums, |det_a, ass_a| (det_a * ass_a).sqrt()),
            det_a: mean(&sums, |det_a, _| det_a),
            ass_a: mean(&sums, |_, ass_a| ass_a),
        })
    }
}

/// Mean over the thresholds of a value that follows from DetA and AssA.
fn mean(sums: &[Sums; THRESHOLDS], of: fn(f64, f64) -> f64) -> f64 {
    let values = sums.iter().map(|sums| {
        let det_a = sums.matches / (sums.matches + sums.unmatched);
        of(det_a, sums.association / sums.matches.max(1.0))
    });
    values.sum::<f64>() / THRESHOLDS as f64
}

/// Similarities of the objects (rows) and tracks (columns) of a frame.
fn similarities(frame: &TrackedFrame) -> DMatrix<f64> {
    DMatrix::from_fn(frame.objects.len(), frame.tracks.len(), |object, track| {
        (1.0 - frame.distance_m(object, track) / MATCH_DISTANCE_M).max(0.0)
    })
}

fn add(sequence: &Sequence, sums: &mut [Sums; THRESHOLDS]) {
    let lengths = sequence.lengths();
    let alignment = alignment(sequence, &lengths);
    let mut matches: [PairValues; THRESHOLDS] = Default::default();
    for frame in &sequence.frames {
        let similarity = similarities(frame);
        let costs = DMatrix::from_fn(similarity.nrows(), similarity.ncols(), |object, track| {
            let ids = (frame.objects[object].id, frame.tracks[track].id);
            let aligned = alignment.get(&ids).copied().unwrap_or(0.0);
            -aligned * similarity[(object, track)]
        });
        // One assignment for all thresholds, as its costs do not depend on them.
        let pairs = assignment::of_lowest_cost(&costs);
        for (index, (sums, matches)) in sums.iter_mut().zip(&mut matches).enumerate() {
            // A similarity that equals the threshold has to pass in spite of rounding.
            let threshold = 0.05 * (index + 1) as f64 - f64::EPSILON;
            let near = pairs.iter().filter(|&&pair| similarity[pair] >= threshold);
            let before = sums.matches;
            for &(object, track) in near {
                let ids = (frame.objects[object].id, frame.tracks[track].id);
                *matches.entry(ids).or_default() += 1.0;
                sums.matches += 1.0;
            }
            let points = (frame.objects.len() + frame.tracks.len()) as f64;
            sums.unmatched += points - 2.0 * (sums.matches - before);
        }
    }
    for (sums, matches) in sums.iter_mut().zip(&matches) {
        for (pair, count) in matches {
            sums.association += count * jaccard(&lengths, pair, *count);
        }
    }
}

/// Jaccard index of each object and track over the sequence, with matches weighted by their similarity among those of
/// the frame.
fn alignment(sequence: &Sequence, lengths: &(Lengths<i64>, Lengths<u64>)) -> PairValues {
    let mut weights = PairValues::new();
    for frame in &sequence.frames {
        let similarity = similarities(frame);
        // The sum of all columns: one number per row, that is per object.
        let of_object = similarity.column_sum();
        let of_track = similarity.row_sum();
        for (object, true_point) in frame.objects.iter().enumerate() {
            for (track, point) in frame.tracks.iter().enumerate() {
                let own = similarity[(object, track)];
                let all = of_object[object] + of_track[track] - own;
                if own > 0.0 && all > f64::EPSILON {
                    *weights.entry((true_point.id, point.id)).or_default() += own / all;
                }
            }
        }
    }
    for (pair, weight) in &mut weights {
        *weight = jaccard(lengths, pair, *weight);
    }
    weights
}

/// Frames that both have over frames that either has.
fn jaccard(
    (objects, tracks): &(Lengths<i64>, Lengths<u64>),
    (object, track): &(i64, u64),
    both: f64,
) -> f64 {
    let [object, track] = [objects.get(object), tracks.get(track)]
        .map(|frames| f64::from(frames.copied().unwrap_or(0)));
    both / (object + track - both)
}
