//! AMOTA and AMOTP: MOTA and MOTP averaged over the recall that a threshold on the score gives.
//!
//! As `nuscenes-devkit` 1.2.0 computes them: every point has the mean score of its track; the 40 thresholds are the
//! scores at which recalls from 0.1 to 1 are reached. Tracks are not interpolated over missing frames: the devkit's
//! loader does that for key frames at 2 Hz, before it evaluates.

use super::MATCH_DISTANCE_M;
use super::clear_mot::ClearMot;
use super::sequence::Sequence;

/// Number of recall values.
const THRESHOLDS: usize = 40;
/// Lowest recall value.
const MIN_RECALL: f64 = 0.1;

/// Averages over the recall values, and the threshold of the best MOTA.
#[derive(Debug, Clone, PartialEq)]
pub struct Amota {
    /// Mean of MOTAR, 0..=1: MOTA scaled by recall and cut at 0. A recall that is not reached counts as 0. Recall here
    /// counts matches without switches.
    pub amota: f64,
    /// Mean of MOTP, metres. A recall that is not reached counts as 2.
    pub amotp_m: f64,
    /// The threshold of the highest MOTA; of the highest recall where several have it. `None` if no track matches.
    pub best: Option<OperatingPoint>,
}

/// Tracks from a score on.
#[derive(Debug, Clone, PartialEq)]
pub struct OperatingPoint {
    /// Lowest mean score of a track.
    pub min_score: f64,
    /// Counts of these tracks.
    pub counts: ClearMot,
}

impl Amota {
    /// Averages over all sequences; `None` without true objects.
    pub fn of(sequences: &[Sequence]) -> Option<Self> {
        let sequences: Vec<Sequence> = sequences.iter().map(Sequence::with_mean_scores).collect();
        let at_all = ClearMot::of(&sequences, MATCH_DISTANCE_M);
        if at_all.objects == 0 {
            return None;
        }
        let (mut amota, mut amotp_m) = (0.0, 0.0);
        let mut best: Option<OperatingPoint> = None;
        let mut last: Option<OperatingPoint> = None;
        for threshold in thresholds(&at_all) {
            let Some(min_score) = threshold else {
                amotp_m += MATCH_DISTANCE_M;
                continue;
            };
            // With few matches several recalls have the same threshold: their counts are made once.
            let point = match last.take().filter(|last| last.min_score == min_score) {
                Some(same) => same,
                None => OperatingPoint::of(&sequences, min_score),
            };
            amota += motar(&point.counts);
            amotp_m += point.counts.motp_m().unwrap_or(MATCH_DISTANCE_M);
            // Recalls fall: of equal values the first, that of the highest recall, stays.
            let mota = best.as_ref().map(OperatingPoint::clipped_mota);
            if mota.is_none_or(|mota| point.clipped_mota() > mota) {
                best = Some(point.clone());
            }
            last = Some(point);
        }
        Some(Self {
            amota: amota / THRESHOLDS as f64,
            amotp_m: amotp_m / THRESHOLDS as f64,
            best,
        })
    }
}

impl OperatingPoint {
    fn of(sequences: &[Sequence], min_score: f64) -> Self {
        let kept = Sequence::with_min_score(sequences, min_score);
        let counts = ClearMot::of(&kept, MATCH_DISTANCE_M);
        Self { min_score, counts }
    }

    fn clipped_mota(&self) -> f64 {
        self.counts.mota().unwrap_or(0.0).max(0.0)
    }
}

/// MOTA without the misses that the recall implies, relative to the recall, at least 0.
fn motar(counts: &ClearMot) -> f64 {
    let objects = counts.objects as f64;
    let recall = counts.matches as f64 / objects;
    if counts.matches == 0 {
        return 0.0;
    }
    let errors = (counts.misses + counts.switches + counts.false_positives) as f64;
    let unavoidable = (1.0 - recall) * objects;
    (1.0 - (errors - unavoidable) / (recall * objects)).max(0.0)
}

/// The score at which each recall value is reached, from recall 1 down; `None` where it is not.
fn thresholds(at_all: &ClearMot) -> Vec<Option<f64>> {
    let mut scores = at_all.match_scores.clone();
    scores.sort_by(|a, b| b.total_cmp(a));
    let objects = at_all.objects as f64;
    let step = (1.0 - MIN_RECALL) / (THRESHOLDS - 1) as f64;
    let recalls = (0..THRESHOLDS).rev().map(|index| {
        let recall = match index + 1 {
            THRESHOLDS => 1.0,
            _ => MIN_RECALL + step * index as f64,
        };
        // Twelve decimals, so that 0.2 reaches 0.2.
        (recall * 1e12).round_ties_even() / 1e12
    });
    let scores_at = recalls.map(|recall| {
        let above = (0..scores.len()).find(|&index| (index + 1) as f64 / objects >= recall)?;
        let Some(below) = above.checked_sub(1) else {
            return scores.first().copied();
        };
        let [low, high] = [below, above].map(|index| (index + 1) as f64 / objects);
        if recall == high {
            return Some(scores[above]);
        }
        let slope = (scores[above] - scores[below]) / (high - low);
        Some(slope * (recall - low) + scores[below])
    });
    scores_at.collect()
}
