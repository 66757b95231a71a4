//! IDF1: share of points with the right identity under the best one-to-one mapping of tracks to objects.

use std::collections::BTreeMap;

use nalgebra::DMatrix;

use super::sequence::Sequence;
use crate::assignment;

/// Points with the right identity, and all points.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct IdentityCounts {
    /// Object points whose track is the one mapped to their object (IDTP).
    pub matches: u64,
    /// Object points.
    pub objects: u64,
    /// Track points.
    pub tracks: u64,
}

impl IdentityCounts {
    /// Points over all sequences; pairs at less than `max_distance_m` can match. The mapping is made for each sequence.
    pub fn of(sequences: &[Sequence], max_distance_m: f64) -> Self {
        let mut points = Self::default();
        for sequence in sequences {
            points.add(sequence, max_distance_m);
        }
        points
    }

    /// IDF1; `None` without points.
    pub fn f1(&self) -> Option<f64> {
        let all = self.objects + self.tracks;
        (all > 0).then(|| 2.0 * self.matches as f64 / all as f64)
    }

    fn add(&mut self, sequence: &Sequence, max_distance_m: f64) {
        let (objects, tracks) = sequence.lengths();
        let rows: BTreeMap<i64, usize> = objects.into_keys().zip(0..).collect();
        let columns: BTreeMap<u64, usize> = tracks.into_keys().zip(0..).collect();
        let mut shared = DMatrix::<f64>::zeros(rows.len(), columns.len());
        for frame in &sequence.frames {
            for (object, true_point) in frame.objects.iter().enumerate() {
                for (track, point) in frame.tracks.iter().enumerate() {
                    if frame.distance_m(object, track) < max_distance_m {
                        shared[(rows[&true_point.id], columns[&point.id])] += 1.0;
                    }
                }
            }
            self.objects += frame.objects.len() as u64;
            self.tracks += frame.tracks.len() as u64;
        }
        let best = assignment::of_lowest_cost(&-&shared);
        let matches = best.into_iter().map(|pair| shared[pair] as u64);
        self.matches += matches.sum::<u64>();
    }
}
