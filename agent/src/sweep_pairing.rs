//! Sweep pairing: matches each sweep with the measured pose of the same capture time.

use std::collections::BTreeMap;
use std::ops::Bound;
use std::time::{Duration, Instant};

use protocol::Pose;

/// Poses kept for sweeps that have not arrived: at 10 Hz three seconds.
const MAX_POSES: usize = 32;

/// A sweep and its pose, if that has arrived.
#[derive(Debug, PartialEq)]
pub struct PairedSweep<S> {
    /// Capture time, nanoseconds.
    pub capture_nanos: u64,
    /// The sweep.
    pub sweep: S,
    /// The pose measured at the same time.
    pub pose: Option<Pose>,
}

/// Holds the newest sweep until its pose arrives, or is known to be lost.
#[derive(Debug)]
pub struct SweepPairing<S> {
    timeout: Duration,
    waiting: Option<(u64, S, Instant)>,
    poses: BTreeMap<u64, Pose>,
}

impl<S> SweepPairing<S> {
    /// Pairing with at most `timeout` of waiting for the pose of a sweep.
    #[must_use]
    pub fn new(timeout: Duration) -> Self {
        Self { timeout, waiting: None, poses: BTreeMap::new() }
    }

    /// Adds a pose. Returns how many others were dropped: the oldest if there are too many, and those of later sweeps.
    /// Poses arrive in order, so a later one is left over from before the scene restarted.
    #[must_use]
    pub fn add_pose(&mut self, capture_nanos: u64, pose: Pose) -> usize {
        let left_over = self.take_later(capture_nanos).len();
        let replaced = usize::from(self.poses.insert(capture_nanos, pose).is_some());
        let too_many = self.poses.len().saturating_sub(MAX_POSES);
        for _ in 0..too_many {
            self.poses.pop_first();
        }
        left_over + replaced + too_many
    }

    /// Removes the poses of later sweeps.
    fn take_later(&mut self, capture_nanos: u64) -> BTreeMap<u64, Pose> {
        // No capture time is later than the largest one.
        capture_nanos.checked_add(1).map_or_else(BTreeMap::new, |next| self.poses.split_off(&next))
    }

    /// Adds a sweep. Returns the one that it replaces.
    #[must_use]
    pub fn add_sweep(&mut self, capture_nanos: u64, sweep: S, now: Instant) -> Option<S> {
        self.waiting.replace((capture_nanos, sweep, now)).map(|(_, superseded, _)| superseded)
    }

    /// The sweep, if there is nothing left to wait for, and the number of poses without a sweep.
    pub fn next(&mut self, now: Instant) -> Option<(PairedSweep<S>, usize)> {
        let &(capture_nanos, _, since) = self.waiting.as_ref()?;
        let pose = self.poses.get(&capture_nanos).copied();
        // Poses arrive in order: a later one shows that this sweep's own is lost.
        let is_lost = self.poses.range((Bound::Excluded(capture_nanos), Bound::Unbounded)).next().is_some();
        if pose.is_none() && !is_lost && now < since + self.timeout {
            return None;
        }
        let later = self.take_later(capture_nanos);
        let unused = self.poses.len() - usize::from(pose.is_some());
        self.poses = later;
        let (_, sweep, _) = self.waiting.take()?;
        Some((PairedSweep { capture_nanos, sweep, pose }, unused))
    }

    /// Time of the next call of [`Self::next`] if nothing arrives.
    #[must_use]
    pub fn deadline(&self) -> Option<Instant> {
        self.waiting.as_ref().map(|(_, _, since)| *since + self.timeout)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const TIMEOUT: Duration = Duration::from_millis(200);

    fn at(x_m: f64) -> Pose {
        Pose::from_xyz_yaw([x_m, 0.0, 0.0], 0.0)
    }

    fn paired(pairing: &mut SweepPairing<char>, now: Instant) -> Option<(u64, char, Option<f64>, usize)> {
        let (PairedSweep { capture_nanos, sweep, pose }, unused) = pairing.next(now)?;
        Some((capture_nanos, sweep, pose.map(|pose| pose.translation_m[0]), unused))
    }

    #[test]
    fn a_sweep_is_paired_with_its_pose_in_either_order() {
        let (mut pairing, now) = (SweepPairing::new(TIMEOUT), Instant::now());
        assert_eq!(pairing.add_pose(10, at(1.0)), 0);
        assert_eq!(pairing.add_sweep(10, 'a', now), None);
        assert_eq!(paired(&mut pairing, now), Some((10, 'a', Some(1.0), 0)));
        assert_eq!(pairing.add_sweep(20, 'b', now), None);
        assert_eq!(paired(&mut pairing, now), None);
        assert_eq!(pairing.add_pose(20, at(2.0)), 0);
        assert_eq!(paired(&mut pairing, now), Some((20, 'b', Some(2.0), 0)));
    }

    #[test]
    fn a_lost_pose_is_noticed_by_the_next_or_by_the_time() {
        let (mut pairing, now) = (SweepPairing::new(TIMEOUT), Instant::now());
        assert_eq!(pairing.add_sweep(10, 'a', now), None);
        assert_eq!(pairing.add_pose(20, at(2.0)), 0);
        assert_eq!(paired(&mut pairing, now), Some((10, 'a', None, 0)));
        assert_eq!(pairing.add_sweep(30, 'c', now), None);
        assert_eq!(paired(&mut pairing, now), None);
        assert_eq!(pairing.deadline(), Some(now + TIMEOUT));
        assert_eq!(paired(&mut pairing, now + TIMEOUT), Some((30, 'c', None, 1)), "the pose of 20 has no sweep");
    }

    #[test]
    fn a_restarted_scene_is_not_mistaken_for_one_with_lost_poses() {
        let (mut pairing, now) = (SweepPairing::new(TIMEOUT), Instant::now());
        assert_eq!(pairing.add_pose(90, at(9.0)) + pairing.add_pose(100, at(10.0)), 0);
        assert_eq!(pairing.add_pose(10, at(1.0)), 2, "those of the old scene are dropped and counted");
        assert_eq!(pairing.add_sweep(20, 'b', now), None);
        assert_eq!(paired(&mut pairing, now), None, "its own may still arrive");
        assert_eq!(pairing.add_pose(20, at(2.0)), 0);
        assert_eq!(paired(&mut pairing, now), Some((20, 'b', Some(2.0), 1)));
        assert_eq!(pairing.add_pose(30, at(3.0)), 0);
        assert_eq!(pairing.add_pose(30, at(4.0)), 1, "nor is one of the same time lost silently");
    }

    #[test]
    fn the_largest_capture_time_has_no_later_poses() {
        let (mut pairing, now) = (SweepPairing::new(TIMEOUT), Instant::now());
        assert_eq!(pairing.add_pose(10, at(1.0)) + pairing.add_pose(u64::MAX, at(2.0)), 0);
        assert_eq!(pairing.add_sweep(u64::MAX, 'z', now), None);
        assert_eq!(paired(&mut pairing, now), Some((u64::MAX, 'z', Some(2.0), 1)));
        assert_eq!(pairing.add_sweep(u64::MAX, 'z', now), None);
        assert_eq!(paired(&mut pairing, now), None);
    }

    #[test]
    fn replaced_sweeps_are_returned() {
        let (mut pairing, now) = (SweepPairing::new(TIMEOUT), Instant::now());
        assert_eq!(pairing.add_sweep(10, 'a', now), None);
        assert_eq!(pairing.add_sweep(20, 'b', now), Some('a'));
        let gone: usize = (0..40).map(|k| pairing.add_pose(100 + k, at(0.0))).sum();
        assert_eq!(gone, 40 - MAX_POSES);
    }
}
