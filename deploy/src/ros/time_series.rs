//! Measured quantities over time: their values at the capture time of a sweep, and the mean between two sweeps.
//!
//! Odometry, gyroscopes and transforms have rates and stamps of their own.

use std::collections::VecDeque;

use nalgebra::Isometry3;

/// Longest time from a measurement to the next, and to a time that has none after it, nanoseconds: 0.2 s.
const MAX_GAP_NANOS: u64 = 200_000_000;
/// Longest time between two poses that are interpolated, nanoseconds: 1 s.
const MAX_POSE_GAP_NANOS: u64 = 1_000_000_000;
/// Time for which measurements are kept, nanoseconds: a slow localizer's pose is of a sweep some seconds ago.
const KEPT_NANOS: u64 = 10_000_000_000;
/// Most measurements that are kept.
const MOST: usize = 4096;

/// Measurements in the order of time.
#[derive(Debug, Default)]
pub(super) struct TimeSeries<T>(VecDeque<(u64, T)>);

/// Reason why there is no pose at a time.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum NoPose {
    /// It may still come: the time is later than the last pose.
    Later,
    /// The time is before the first pose, or in a gap.
    Never,
}

impl<T: Copy> TimeSeries<T> {
    /// Adds a measurement. Those of the same or later times are discarded, since a bag has begun again; their number.
    pub(super) fn add(&mut self, nanos: u64, value: T) -> u64 {
        let mut discarded = 0;
        while self.0.back().is_some_and(|(last, _)| *last >= nanos) {
            self.0.pop_back();
            discarded += 1;
        }
        self.0.push_back((nanos, value));
        // No underflow: measurements are in the order of time, and this one is the last.
        while self.0.len() > MOST || self.0.front().is_some_and(|it| nanos - it.0 > KEPT_NANOS) {
            self.0.pop_front();
        }
        discarded
    }

    /// The latest measurement.
    pub(super) fn last(&self) -> Option<T> {
        self.0.back().map(|(_, value)| *value)
    }

    /// The last measurement before a time, and the first that is not.
    fn around(&self, nanos: u64) -> [Option<(u64, T)>; 2] {
        let next = self.0.partition_point(|(time, _)| *time < nanos);
        [next.checked_sub(1), Some(next)].map(|index| self.0.get(index?).copied())
    }
}

impl TimeSeries<Isometry3<f64>> {
    /// The pose at a time, interpolated between the two around it.
    pub(super) fn at(&self, nanos: u64) -> Result<Isometry3<f64>, NoPose> {
        let [before, after] = self.around(nanos);
        let (to, last) = after.ok_or(NoPose::Later)?;
        if to == nanos {
            return Ok(last);
        }
        let (from, first) = before.ok_or(NoPose::Never)?;
        let share = seconds(nanos - from) / seconds(to - from);
        // Half a turn between two poses cannot be interpolated.
        (to - from <= MAX_POSE_GAP_NANOS)
            .then(|| first.try_lerp_slerp(&last, share, 1e-9))
            .flatten()
            .ok_or(NoPose::Never)
    }
}

impl TimeSeries<f64> {
    /// The value at a time: between two measurements the straight line, else the nearest one that is near enough.
    pub(super) fn at(&self, nanos: u64) -> Option<f64> {
        let [before, after] = self.around(nanos);
        match (before, after) {
            // The first is before the time and the second is not, so the interval is never 0.
            (Some((from, first)), Some((to, last))) if to - from <= MAX_GAP_NANOS => {
                Some(first + (last - first) * seconds(nanos - from) / seconds(to - from))
            }
            _ => {
                let both = [before, after].into_iter().flatten();
                let nearest = both.min_by_key(|(time, _)| time.abs_diff(nanos))?;
                (nearest.0.abs_diff(nanos) <= MAX_GAP_NANOS).then_some(nearest.1)
            }
        }
    }

    /// The mean from one time to a later one, by the trapezoidal rule; the value at `to` where that at `from` is unknown
    /// or none after it.
    pub(super) fn mean(&self, from: u64, to: u64) -> Option<f64> {
        let last = self.at(to)?;
        let Some(first) = self.at(from).filter(|_| from < to) else {
            return Some(last);
        };
        // Both ends have values of their own, so only what lies strictly between them is taken.
        let all = self.0.iter().copied();
        let between = all.filter(|(time, _)| (from + 1..to).contains(time));
        let (mut sum, mut previous) = (0.0, (from, first));
        for next in between.chain([(to, last)]) {
            sum += 0.5 * (previous.1 + next.1) * seconds(next.0 - previous.0);
            previous = next;
        }
        Some(sum / seconds(to - from))
    }
}

pub(super) fn seconds(nanos: u64) -> f64 {
    nanos as f64 * 1e-9
}

#[cfg(test)]
mod tests {
    use super::*;

    const MS: u64 = 1_000_000;

    fn series(values: &[(u64, f64)]) -> TimeSeries<f64> {
        let mut series = TimeSeries::default();
        for (ms, value) in values {
            assert_eq!(series.add(ms * MS, *value), 0);
        }
        series
    }

    #[test]
    fn a_value_is_interpolated_and_held_for_a_short_time() {
        let series = series(&[(1000, 2.0), (1020, 4.0), (1500, 9.0)]);
        for (ms, value) in [(1000, 2.0), (1010, 3.0), (1020, 4.0)] {
            assert_eq!(series.at(ms * MS), Some(value), "{ms} ms");
        }
        for (ms, value) in [(900, 2.0), (1100, 4.0), (1600, 9.0)] {
            assert_eq!(series.at(ms * MS), Some(value), "{ms} ms");
        }
        for ms in [700, 1250, 1701] {
            assert_eq!(series.at(ms * MS), None, "{ms} ms");
        }
        assert_eq!(TimeSeries::<f64>::default().at(5), None);
    }

    #[test]
    fn a_pose_is_interpolated_and_awaited_but_never_extrapolated() {
        let mut series = TimeSeries::default();
        for (ms, x) in [(1000, 2.0), (1100, 4.0), (3000, 9.0)] {
            series.add(ms * MS, Isometry3::translation(x, 0.0, 0.0));
        }
        for (ms, expected) in [
            (1000, Ok(2.0)),
            (1050, Ok(3.0)),
            (3001, Err(NoPose::Later)),
            (999, Err(NoPose::Never)),
            (2000, Err(NoPose::Never)),
        ] {
            let x = series.at(ms * MS).map(|pose| pose.translation.x);
            assert_eq!(x, expected, "{ms} ms");
        }
    }

    #[test]
    fn the_mean_of_a_line_is_its_middle_and_that_of_a_constant_the_constant() {
        let line = series(
            &(0..=10)
                .map(|k| (1000 + 20 * k, k as f64))
                .collect::<Vec<_>>(),
        );
        assert!((line.mean(1000 * MS, 1200 * MS).unwrap() - 5.0).abs() < 1e-9);
        assert!((line.mean(1050 * MS, 1150 * MS).unwrap() - 5.0).abs() < 1e-9);
        let constant = series(&[(1000, 0.5), (1030, 0.5), (1110, 0.5)]);
        assert!((constant.mean(1010 * MS, 1200 * MS).unwrap() - 0.5).abs() < 1e-12);
        assert_eq!(
            constant.mean(100 * MS, 1100 * MS),
            Some(0.5),
            "nothing is known of the beginning"
        );
        assert_eq!(constant.mean(1100 * MS, 1100 * MS), Some(0.5));
        assert_eq!(constant.mean(1000 * MS, 2000 * MS), None);
    }

    #[test]
    fn a_bag_that_begins_again_leaves_nothing_of_before() {
        let mut series = series(&[(1000, 1.0), (1020, 2.0)]);
        assert_eq!(series.add(500 * MS, 7.0), 2);
        assert_eq!(
            (series.at(1010 * MS), series.at(500 * MS)),
            (None, Some(7.0))
        );
        (0..10_000).for_each(|k| assert_eq!(series.add(3_000 * MS + k, 0.0), 0));
        assert_eq!(series.0.len(), MOST);
        assert_eq!(series.add(90_000 * MS, 0.0), 0);
        assert_eq!(series.0.len(), 1);
    }
}
