//! CLEAR MOT: matches, misses, false positives and identity switches, frame after frame.

use std::collections::BTreeMap;

use super::sequence::{Sequence, TrackedFrame};
use crate::assignment;

/// Share of its frames from which an object is mostly tracked.
const MOSTLY_TRACKED: f64 = 0.8;
/// Share below which it is mostly lost.
const MOSTLY_LOST: f64 = 0.2;

/// Counts of CLEAR MOT, and the rates that follow from them.
///
/// An object keeps the track that it had last while both are in the frame and near enough; the rest is matched for as
/// many pairs as possible, then for the lowest sum of distances.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct ClearMot {
    /// Object points.
    pub objects: usize,
    /// Matches that are no switch.
    pub matches: usize,
    /// Identity switches (IDS): matches with another track than the object's last one.
    pub switches: usize,
    /// Object points without a track (FN).
    pub misses: usize,
    /// Track points without an object (FP).
    pub false_positives: usize,
    /// Interruptions (FRAG): changes from tracked to missed before an object is tracked again.
    pub fragmentations: usize,
    /// Objects that are tracked in at least 80 % of their frames (MT).
    pub mostly_tracked: usize,
    /// Objects that are tracked in less than 20 % of their frames (ML).
    pub mostly_lost: usize,
    /// True tracks.
    pub true_tracks: usize,
    /// Sum of the distances of matches and switches, metres.
    pub distance_sum_m: f64,
    /// Scores of the matches that are no switch.
    pub(crate) match_scores: Vec<f64>,
}

/// History of an object.
#[derive(Debug, Clone, Default)]
struct ObjectHistory {
    frames: u32,
    tracked: u32,
    last_track: Option<u64>,
    is_missed: bool,
}

impl ClearMot {
    /// Counts over all sequences of pairs at less than `max_distance_m`.
    pub fn of(sequences: &[Sequence], max_distance_m: f64) -> Self {
        let mut counts = Self::default();
        for sequence in sequences {
            let mut histories = BTreeMap::<i64, ObjectHistory>::new();
            for frame in &sequence.frames {
                counts.add(frame, &mut histories, max_distance_m);
            }
            for history in histories.values() {
                let share = f64::from(history.tracked) / f64::from(history.frames);
                counts.mostly_tracked += usize::from(share >= MOSTLY_TRACKED);
                counts.mostly_lost += usize::from(share < MOSTLY_LOST);
            }
            counts.true_tracks += histories.len();
        }
        counts
    }

    /// MOTA, at most 1; `None` without objects.
    pub fn mota(&self) -> Option<f64> {
        let errors = self.misses + self.false_positives + self.switches;
        (self.objects > 0).then(|| 1.0 - errors as f64 / self.objects as f64)
    }

    /// MOTP: mean distance of matches and switches, metres; `None` without them.
    pub fn motp_m(&self) -> Option<f64> {
        let detected = self.matches + self.switches;
        (detected > 0).then(|| self.distance_sum_m / detected as f64)
    }

    /// Share of the object points that a track matches, switches included; `None` without objects.
    pub fn recall(&self) -> Option<f64> {
        let detected = (self.matches + self.switches) as f64;
        (self.objects > 0).then(|| detected / self.objects as f64)
    }

    fn add(
        &mut self,
        frame: &TrackedFrame,
        histories: &mut BTreeMap<i64, ObjectHistory>,
        max_distance_m: f64,
    ) {
        let pairs = pairs(frame, histories, max_distance_m);
        let mut track_of = vec![None; frame.objects.len()];
        for &(object, track) in &pairs {
            track_of[object] = Some(track);
        }
        for (index, (object, track)) in frame.objects.iter().zip(track_of).enumerate() {
            let history = histories.entry(object.id).or_default();
            history.frames += 1;
            let Some(track) = track else {
                self.misses += 1;
                history.is_missed = true;
                continue;
            };
            let matched = &frame.tracks[track];
            self.distance_sum_m += frame.distance_m(index, track);
            // The last track outlives misses: a return under another id is a switch.
            match history.last_track.replace(matched.id) {
                Some(last) if last != matched.id => self.switches += 1,
                _ => {
                    self.matches += 1;
                    self.match_scores.push(matched.score);
                }
            }
            self.fragmentations += usize::from(history.is_missed && history.tracked > 0);
            history.tracked += 1;
            history.is_missed = false;
        }
        self.objects += frame.objects.len();
        self.false_positives += frame.tracks.len() - pairs.len();
    }
}

/// Pairs of indices of objects and tracks in a frame.
fn pairs(
    frame: &TrackedFrame,
    histories: &BTreeMap<i64, ObjectHistory>,
    max_distance_m: f64,
) -> Vec<(usize, usize)> {
    let (objects, tracks) = (frame.objects.len(), frame.tracks.len());
    let mut is_taken = (vec![false; objects], vec![false; tracks]);
    let mut kept = Vec::new();
    for (index, object) in frame.objects.iter().enumerate() {
        let history = histories.get(&object.id);
        let last = history.and_then(|history| history.last_track);
        let track = last.and_then(|last| frame.tracks.iter().position(|track| track.id == last));
        // Two objects may have had the same track last: the first one in the frame keeps it.
        if let Some(track) = track
            && !is_taken.1[track]
            && frame.distance_m(index, track) < max_distance_m
        {
            (is_taken.0[index], is_taken.1[track]) = (true, true);
            kept.push((index, track));
        }
    }
    kept.extend(assignment::of_allowed(objects, tracks, |object, track| {
        let is_free = !is_taken.0[object] && !is_taken.1[track];
        let distance_m = frame.distance_m(object, track);
        (is_free && distance_m < max_distance_m).then_some(distance_m)
    }));
    kept
}
