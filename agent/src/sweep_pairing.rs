//! Sweep pairing: matches each sweep with the measured pose and motion of the same capture time.

use std::collections::BTreeMap;
use std::ops::Bound;

use protocol::{EgoMotion, Pose};

/// Measurements kept for sweeps that have not arrived: at 10 Hz three seconds.
const MAX_MEASUREMENTS: usize = 32;

/// A sweep with its measurements, if they have arrived.
#[derive(Debug, PartialEq)]
pub(crate) struct PairedSweep<S> {
    /// Capture time, nanoseconds.
    pub(crate) capture_nanos: u64,
    /// The sweep.
    pub(crate) sweep: S,
    /// The pose measured at the same time.
    pub(crate) pose: Option<Pose>,
    /// The motion measured at the same time.
    pub(crate) motion: Option<EgoMotion>,
    /// Number of poses of earlier sweeps, which were superseded.
    pub(crate) unused_poses: usize,
    /// Number of their motions.
    pub(crate) unused_motions: usize,
}

/// Holds the newest sweep until its measured pose and motion arrive, or are known to be lost. Vehicles without a GNSS
/// receiver or a motion sensor do not wait for them: after one sweep without a measurement none of its kind is awaited
/// until one arrives.
#[derive(Debug)]
pub(crate) struct SweepPairing<S> {
    timeout_nanos: u64,
    /// Capture time, the sweep, and the time since which it waits, nanoseconds.
    waiting: Option<(u64, S, u64)>,
    pub(crate) poses: CaptureBuffer<Pose>,
    pub(crate) motions: CaptureBuffer<EgoMotion>,
}

impl<S> SweepPairing<S> {
    /// Pairing with at most `timeout_nanos` of waiting for the measurements of a sweep.
    pub(crate) fn new(timeout_nanos: u64) -> Self {
        Self {
            timeout_nanos,
            waiting: None,
            poses: CaptureBuffer::new(),
            motions: CaptureBuffer::new(),
        }
    }

    /// Adds a sweep. Returns the one that it replaces.
    pub(crate) fn add_sweep(&mut self, capture_nanos: u64, sweep: S, now_nanos: u64) -> Option<S> {
        // The wait goes on: with a period shorter than the time-out, none would ever be over if each sweep began anew.
        let waiting = self.waiting.as_ref();
        let since = waiting.map_or(now_nanos, |(_, _, since)| *since);
        let superseded = self.waiting.replace((capture_nanos, sweep, since));
        superseded.map(|(_, sweep, _)| sweep)
    }

    /// The sweep, if there is nothing left to wait for.
    pub(crate) fn next(&mut self, now_nanos: u64) -> Option<PairedSweep<S>> {
        let &(capture_nanos, ..) = self.waiting.as_ref()?;
        let is_awaited =
            self.poses.is_awaited(capture_nanos) || self.motions.is_awaited(capture_nanos);
        if is_awaited && now_nanos < self.deadline_nanos()? {
            return None;
        }
        let (pose, unused_poses) = self.poses.take(capture_nanos);
        let (motion, unused_motions) = self.motions.take(capture_nanos);
        let (_, sweep, _) = self.waiting.take()?;
        Some(PairedSweep {
            capture_nanos,
            sweep,
            pose,
            motion,
            unused_poses,
            unused_motions,
        })
    }

    /// Time of the next call of [`Self::next`] if nothing arrives, nanoseconds; `None`: no sweep waits.
    pub(crate) fn deadline_nanos(&self) -> Option<u64> {
        let (_, _, since_nanos) = self.waiting.as_ref()?;
        Some(since_nanos.saturating_add(self.timeout_nanos))
    }
}

/// Measurements of one sensor by capture time.
#[derive(Debug)]
pub(crate) struct CaptureBuffer<T> {
    measurements: BTreeMap<u64, T>,
    /// False once a sweep had to do without one, until one arrives.
    is_expected: bool,
}

impl<T> CaptureBuffer<T> {
    fn new() -> Self {
        Self {
            measurements: BTreeMap::new(),
            is_expected: true,
        }
    }

    /// Adds a measurement. Returns how many others were dropped: the oldest if there are too many, and those of later
    /// sweeps. Measurements arrive in order, so a later one is left over from before the scene restarted.
    pub(crate) fn add(&mut self, capture_nanos: u64, measurement: T) -> usize {
        self.is_expected = true;
        let left_over = self.take_later(capture_nanos).len();
        let replaced = self.measurements.insert(capture_nanos, measurement);
        let too_many = self.measurements.len().saturating_sub(MAX_MEASUREMENTS);
        for _ in 0..too_many {
            self.measurements.pop_first();
        }
        left_over + usize::from(replaced.is_some()) + too_many
    }

    /// True if the measurement may still arrive. They arrive in order: a later one shows that it is lost.
    fn is_awaited(&self, capture_nanos: u64) -> bool {
        let later = (Bound::Excluded(capture_nanos), Bound::Unbounded);
        self.is_expected
            && !self.measurements.contains_key(&capture_nanos)
            && self.measurements.range(later).next().is_none()
    }

    /// Removes the measurement and all earlier ones, which it counts.
    fn take(&mut self, capture_nanos: u64) -> (Option<T>, usize) {
        let later = self.take_later(capture_nanos);
        let measurement = self.measurements.remove(&capture_nanos);
        let unused = self.measurements.len();
        // One of a later sweep shows a sensor, although that of this sweep is lost.
        self.is_expected = measurement.is_some() || !later.is_empty();
        self.measurements = later;
        (measurement, unused)
    }

    /// Removes the measurements of later sweeps.
    fn take_later(&mut self, capture_nanos: u64) -> BTreeMap<u64, T> {
        // No capture time is later than the largest one.
        capture_nanos
            .checked_add(1)
            .map_or_else(BTreeMap::new, |next| self.measurements.split_off(&next))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const TIMEOUT: u64 = 200_000_000;
    /// A time, nanoseconds.
    const NOW: u64 = 1_000_000_000;

    fn without_motion() -> SweepPairing<char> {
        let mut pairing = SweepPairing::new(TIMEOUT);
        pairing.motions.is_expected = false;
        pairing
    }

    fn at(x_m: f64) -> Pose {
        Pose::from_xyz_yaw([x_m, 0.0, 0.0], 0.0)
    }

    fn paired(
        pairing: &mut SweepPairing<char>,
        now: u64,
    ) -> Option<(u64, char, Option<f64>, usize)> {
        let PairedSweep {
            capture_nanos,
            sweep,
            pose,
            unused_poses,
            ..
        } = pairing.next(now)?;
        Some((
            capture_nanos,
            sweep,
            pose.map(|pose| pose.translation_m[0]),
            unused_poses,
        ))
    }

    #[test]
    fn a_sweep_is_paired_with_its_pose_in_either_order() {
        let (mut pairing, now) = (without_motion(), NOW);
        assert_eq!(pairing.poses.add(10, at(1.0)), 0);
        assert_eq!(pairing.add_sweep(10, 'a', now), None);
        assert_eq!(paired(&mut pairing, now), Some((10, 'a', Some(1.0), 0)));
        assert_eq!(pairing.add_sweep(20, 'b', now), None);
        assert_eq!(paired(&mut pairing, now), None);
        assert_eq!(pairing.poses.add(20, at(2.0)), 0);
        assert_eq!(paired(&mut pairing, now), Some((20, 'b', Some(2.0), 0)));
    }

    #[test]
    fn sweeps_of_a_vehicle_without_gnss_are_computed_although_the_next_comes_before_the_time_out() {
        let (mut pairing, now) = (SweepPairing::new(TIMEOUT), NOW);
        let [second, third, fourth] = [1, 2, 3].map(|period| now + period * TIMEOUT / 2);
        assert_eq!(pairing.add_sweep(10, 'a', now), None);
        assert_eq!(paired(&mut pairing, now), None);
        assert_eq!(pairing.add_sweep(20, 'b', second), Some('a'));
        assert_eq!(paired(&mut pairing, second), None);
        assert_eq!(pairing.add_sweep(30, 'c', third), Some('b'));
        assert_eq!(paired(&mut pairing, third), Some((30, 'c', None, 0)));
        assert_eq!(pairing.add_sweep(40, 'd', fourth), None);
        assert_eq!(paired(&mut pairing, fourth), Some((40, 'd', None, 0)));
    }

    #[test]
    fn a_lost_pose_is_noticed_by_the_next_or_by_the_time() {
        let (mut pairing, now) = (without_motion(), NOW);
        assert_eq!(pairing.add_sweep(10, 'a', now), None);
        assert_eq!(pairing.poses.add(20, at(2.0)), 0);
        assert_eq!(paired(&mut pairing, now), Some((10, 'a', None, 0)));
        assert_eq!(pairing.add_sweep(30, 'c', now), None);
        assert_eq!(paired(&mut pairing, now), None);
        assert_eq!(pairing.deadline_nanos(), Some(now + TIMEOUT));
        assert_eq!(
            paired(&mut pairing, now + TIMEOUT),
            Some((30, 'c', None, 1)),
            "the pose of 20 has no sweep"
        );
    }

    #[test]
    fn a_restarted_scene_is_not_mistaken_for_one_with_lost_poses() {
        let (mut pairing, now) = (without_motion(), NOW);
        assert_eq!(
            pairing.poses.add(90, at(9.0)) + pairing.poses.add(100, at(10.0)),
            0
        );
        assert_eq!(
            pairing.poses.add(10, at(1.0)),
            2,
            "those of the old scene are dropped and counted"
        );
        assert_eq!(pairing.add_sweep(20, 'b', now), None);
        assert_eq!(paired(&mut pairing, now), None, "its own may still arrive");
        assert_eq!(pairing.poses.add(20, at(2.0)), 0);
        assert_eq!(paired(&mut pairing, now), Some((20, 'b', Some(2.0), 1)));
        assert_eq!(pairing.poses.add(30, at(3.0)), 0);
        assert_eq!(
            pairing.poses.add(30, at(4.0)),
            1,
            "nor is one of the same time lost silently"
        );
    }

    #[test]
    fn the_largest_capture_time_has_no_later_poses() {
        let (mut pairing, now) = (without_motion(), NOW);
        assert_eq!(
            pairing.poses.add(10, at(1.0)) + pairing.poses.add(u64::MAX, at(2.0)),
            0
        );
        assert_eq!(pairing.add_sweep(u64::MAX, 'z', now), None);
        assert_eq!(
            paired(&mut pairing, now),
            Some((u64::MAX, 'z', Some(2.0), 1))
        );
        assert_eq!(pairing.add_sweep(u64::MAX, 'z', now), None);
        assert_eq!(paired(&mut pairing, now), None);
    }

    #[test]
    fn replaced_sweeps_are_returned() {
        let (mut pairing, now) = (without_motion(), NOW);
        assert_eq!(pairing.add_sweep(10, 'a', now), None);
        assert_eq!(pairing.add_sweep(20, 'b', now), Some('a'));
        let gone: usize = (0..40).map(|k| pairing.poses.add(100 + k, at(0.0))).sum();
        assert_eq!(gone, 40 - MAX_MEASUREMENTS);
    }

    #[test]
    fn a_vehicle_without_a_receiver_of_poses_waits_once() {
        let (mut pairing, now) = (without_motion(), NOW);
        assert_eq!(pairing.add_sweep(10, 'a', now), None);
        assert_eq!(paired(&mut pairing, now), None, "there may be a receiver");
        assert_eq!(
            paired(&mut pairing, now + TIMEOUT),
            Some((10, 'a', None, 0))
        );
        assert_eq!(pairing.add_sweep(20, 'b', now), None);
        assert_eq!(paired(&mut pairing, now), Some((20, 'b', None, 0)));
        assert_eq!(pairing.poses.add(30, at(3.0)), 0);
        assert_eq!(pairing.add_sweep(40, 'c', now), None);
        assert_eq!(paired(&mut pairing, now), None, "there is one now");
    }

    fn add_sweep_with_pose(pairing: &mut SweepPairing<char>, capture_nanos: u64) {
        assert_eq!(pairing.poses.add(capture_nanos, at(1.0)), 0);
        assert_eq!(pairing.add_sweep(capture_nanos, 'a', NOW), None);
    }

    #[test]
    fn a_vehicle_with_a_motion_sensor_waits_for_it_and_one_without_does_not() {
        let (mut pairing, now) = (SweepPairing::new(TIMEOUT), NOW);
        let [slow, fast] = [5.0, 6.0].map(|speed_mps| EgoMotion {
            speed_mps: Some(speed_mps),
            yaw_rate_rad_s: None,
        });
        add_sweep_with_pose(&mut pairing, 10);
        assert_eq!(pairing.next(now), None, "there may be a sensor");
        assert_eq!(pairing.next(now + TIMEOUT).unwrap().motion, None);
        add_sweep_with_pose(&mut pairing, 12);
        assert_eq!(pairing.next(now).unwrap().motion, None, "there is none");
        assert_eq!(
            pairing.motions.add(15, slow) + pairing.motions.add(20, fast),
            0
        );
        add_sweep_with_pose(&mut pairing, 20);
        let paired = pairing.next(now).unwrap();
        assert_eq!(
            (paired.motion, paired.unused_poses, paired.unused_motions),
            (Some(fast), 0, 1)
        );
        add_sweep_with_pose(&mut pairing, 30);
        assert_eq!(pairing.next(now), None, "its motion may still arrive");
        assert_eq!(pairing.next(now + TIMEOUT).unwrap().motion, None);
        add_sweep_with_pose(&mut pairing, 40);
        assert!(pairing.next(now).is_some(), "the sensor is gone");
    }
}
