//! Sweep selection: leaves out sweeps that no ego has time for, the same in every vehicle.

use std::collections::BTreeMap;

use protocol::{CavId, Pace};

/// Largest number of egos whose pace is followed.
pub(crate) const MAX_EGOS: usize = 64;

/// Paces of the egos, and the interval of the last computed sweep under each.
#[derive(Debug, Default)]
pub(crate) struct SweepSelection {
    paces: BTreeMap<CavId, (Pace, Option<i128>)>,
}

impl SweepSelection {
    /// Follows the pace of an ego from now on.
    pub(crate) fn follow(&mut self, ego: &CavId, pace: Pace) {
        let known = self.paces.get(ego).map(|(known, _)| *known);
        // Egos repeat their pace.
        if known != Some(pace) && (known.is_some() || self.paces.len() < MAX_EGOS) {
            self.paces.insert(ego.clone(), (pace, None));
        }
    }

    /// True if a sweep is computed: it is the first of an interval of any ego, or there is no pace. A capture time
    /// before the last one begins anew.
    pub(crate) fn admits(&mut self, capture_nanos: u64) -> bool {
        let mut is_admitted = self.paces.is_empty();
        for (pace, last) in self.paces.values_mut() {
            let interval = pace.interval_of(capture_nanos);
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

    fn computed(selection: &mut SweepSelection, sweeps: std::ops::Range<u64>) -> Vec<u64> {
        sweeps.filter(|sweep| selection.admits(sweep * 100_000_000)).collect()
    }

    fn every(sweeps: u64) -> Pace {
        Pace { interval_nanos: sweeps * 100_000_000, phase_nanos: 300_000_000 }
    }

    #[test]
    fn vehicles_that_hear_of_a_pace_at_different_times_compute_the_same_sweeps() {
        let ego = CavId::new("1").unwrap();
        let (mut early, mut late) = (SweepSelection::default(), SweepSelection::default());
        assert_eq!(computed(&mut early, 0..3), [0, 1, 2]);
        early.follow(&ego, every(3));
        assert_eq!(computed(&mut early, 3..12), [3, 6, 9]);
        assert_eq!(computed(&mut late, 0..4), [0, 1, 2, 3]);
        late.follow(&ego, every(3));
        assert_eq!(computed(&mut late, 4..12), [4, 6, 9], "from the next interval on");
        late.follow(&ego, Pace::EVERY_SWEEP);
        assert_eq!(computed(&mut late, 12..15), [12, 13, 14]);
    }

    #[test]
    fn the_fastest_ego_is_served_and_a_restarted_scene_too() {
        let mut selection = SweepSelection::default();
        selection.follow(&CavId::new("1").unwrap(), every(4));
        selection.follow(&CavId::new("2").unwrap(), every(2));
        assert_eq!(computed(&mut selection, 3..12), [3, 5, 7, 9, 11]);
        assert_eq!(computed(&mut selection, 0..4), [0, 1, 3]);
    }
}
