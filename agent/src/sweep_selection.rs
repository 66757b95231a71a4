//! Sweep selection: leaves out sweeps that no ego has time for, the same in every vehicle.

use std::collections::{BTreeMap, BTreeSet};

use protocol::{CavId, Pace};

/// Largest number of egos whose pace is followed.
pub(crate) const MAX_EGOS: usize = 64;
/// Silence after which the pace of an ego is forgotten, nanoseconds: it repeats its pace every second.
const MAX_SILENCE_NANOS: u64 = 5_000_000_000;

/// Paces of the egos, and the interval of the last computed sweep under each.
#[derive(Debug, Default)]
pub(crate) struct PaceSelection {
    /// Egos of the run; none: any ego is of it.
    egos: BTreeSet<CavId>,
    paces: BTreeMap<CavId, FollowedPace>,
}

/// Pace of one ego.
#[derive(Debug)]
struct FollowedPace {
    pace: Pace,
    /// Interval of the last computed sweep.
    last: Option<i128>,
    /// Time of the last message, nanoseconds.
    received_nanos: u64,
}

impl PaceSelection {
    /// Selection by the paces of `egos` only; of any ego if they are none.
    pub(crate) fn of(egos: &[CavId]) -> Self {
        Self {
            egos: egos.iter().cloned().collect(),
            ..Self::default()
        }
    }

    /// Follows the pace of an ego from now on. False if the ego is not of the run, or there are too many already.
    pub(crate) fn follow(&mut self, ego: &CavId, pace: Pace, now_nanos: u64) -> bool {
        if !self.egos.is_empty() && !self.egos.contains(ego) {
            return false;
        }
        let known = self.paces.get(ego);
        if known.is_none() && self.paces.len() >= MAX_EGOS {
            return false;
        }
        // Egos repeat their pace, which does not begin anew.
        let known = known.filter(|known| known.pace == pace);
        let followed = FollowedPace {
            pace,
            last: known.and_then(|known| known.last),
            received_nanos: now_nanos,
        };
        self.paces.insert(ego.clone(), followed);
        true
    }

    /// Forgets the pace of an ego that has left.
    pub(crate) fn forget(&mut self, ego: &CavId) {
        self.paces.remove(ego);
    }

    /// True if a sweep is computed: it is the first of an interval of any ego, or there is no pace. A capture time
    /// before the last one begins anew.
    pub(crate) fn admits(&mut self, capture_nanos: u64, now_nanos: u64) -> bool {
        self.paces.retain(|ego, followed| {
            let is_active = now_nanos.saturating_sub(followed.received_nanos) <= MAX_SILENCE_NANOS;
            if !is_active {
                tracing::info!(%ego, "the ego is silent: its pace is forgotten");
            }
            is_active
        });
        let mut is_admitted = self.paces.is_empty();
        // No early end: the interval of every ego has to be noted.
        for FollowedPace { pace, last, .. } in self.paces.values_mut() {
            let interval = pace.interval_of(capture_nanos);
            // Another interval and not a later one: the clock of the scene may be set back.
            if interval.is_none() || interval != *last {
                is_admitted = true;
                *last = interval;
            }
        }
        is_admitted
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A time, nanoseconds.
    const NOW: u64 = 1_000_000_000;

    fn computed(selection: &mut PaceSelection, sweeps: std::ops::Range<u64>, now: u64) -> Vec<u64> {
        sweeps
            .filter(|sweep| selection.admits(sweep * 100_000_000, now))
            .collect()
    }

    fn every(sweeps: u8) -> Pace {
        Pace {
            period_nanos: 100_000_000,
            phase_nanos: 300_000_000,
            computed: 1,
            of: sweeps,
        }
    }

    #[test]
    fn vehicles_that_receive_a_pace_at_different_times_compute_the_same_sweeps() {
        let (ego, now) = (CavId::new("1").unwrap(), NOW);
        let (mut early, mut late) = (PaceSelection::default(), PaceSelection::default());
        assert_eq!(computed(&mut early, 0..3, now), [0, 1, 2]);
        assert!(early.follow(&ego, every(3), now));
        assert_eq!(computed(&mut early, 3..12, now), [3, 6, 9]);
        assert_eq!(computed(&mut late, 0..4, now), [0, 1, 2, 3]);
        assert!(late.follow(&ego, every(3), now));
        assert_eq!(
            computed(&mut late, 4..12, now),
            [4, 6, 9],
            "from the next interval on"
        );
        assert!(late.follow(&ego, Pace::EVERY_SWEEP, now));
        assert_eq!(computed(&mut late, 12..15, now), [12, 13, 14]);
    }

    #[test]
    fn the_fastest_ego_is_served_and_a_restarted_scene_too() {
        let (mut selection, now) = (PaceSelection::default(), NOW);
        assert!(selection.follow(&CavId::new("1").unwrap(), every(4), now));
        assert!(selection.follow(&CavId::new("2").unwrap(), every(2), now));
        assert_eq!(computed(&mut selection, 3..12, now), [3, 5, 7, 9, 11]);
        assert_eq!(computed(&mut selection, 0..4, now), [0, 1, 3]);
    }

    #[test]
    fn egos_that_leave_or_are_silent_are_forgotten() {
        let (mut selection, now) = (PaceSelection::default(), NOW);
        let [slow, fast, faster] = ["1", "2", "3"].map(|ego| CavId::new(ego).unwrap());
        let later = now + MAX_SILENCE_NANOS;
        assert!(selection.follow(&slow, every(4), now) && selection.follow(&fast, every(2), now));
        assert!(selection.follow(&faster, Pace::EVERY_SWEEP, now));
        assert_eq!(computed(&mut selection, 3..7, now), [3, 4, 5, 6]);
        selection.forget(&faster);
        assert_eq!(computed(&mut selection, 7..15, now), [7, 9, 11, 13]);
        assert!(
            selection.follow(&slow, every(4), later),
            "it repeats its pace"
        );
        assert_eq!(computed(&mut selection, 15..19, later), [15, 17]);
        let silent = later + 1_000_000;
        assert_eq!(computed(&mut selection, 19..27, silent), [19, 23]);
        assert_eq!(
            computed(&mut selection, 27..30, silent + MAX_SILENCE_NANOS),
            [27, 28, 29]
        );
    }

    #[test]
    fn only_egos_of_the_run_set_the_pace() {
        let [own, stranger] = ["1", "2"].map(|ego| CavId::new(ego).unwrap());
        let (mut selection, now) = (PaceSelection::of(std::slice::from_ref(&own)), NOW);
        assert!(!selection.follow(&stranger, every(100), now));
        assert_eq!(computed(&mut selection, 0..3, now), [0, 1, 2]);
        assert!(selection.follow(&own, every(3), now));
        assert!(!selection.follow(&stranger, Pace::EVERY_SWEEP, now));
        assert_eq!(computed(&mut selection, 3..12, now), [3, 6, 9]);
    }

    fn ego(number: usize) -> CavId {
        CavId::new(&number.to_string()).unwrap()
    }

    #[test]
    fn more_egos_than_are_followed_are_refused() {
        let (mut selection, now) = (PaceSelection::default(), NOW);
        assert!((0..MAX_EGOS).all(|number| selection.follow(&ego(number), every(2), now)));
        assert!(!selection.follow(&ego(MAX_EGOS), every(1), now));
        assert!(
            selection.follow(&ego(0), every(3), now),
            "known ones may change"
        );
        selection.forget(&ego(0));
        assert!(selection.follow(&ego(MAX_EGOS), every(1), now));
    }
}
