//! Trajectory: poses in order of time, interpolated between those around a time and never beyond them.

use nalgebra::Isometry3;

/// Poses by time, in any unit.
#[derive(Debug, Clone)]
pub(super) struct Trajectory {
    /// In order of time, without repetitions.
    poses: Vec<(u64, Isometry3<f64>)>,
    /// Largest time between two poses over which they are interpolated.
    max_gap: u64,
}

/// Reason why there is no pose at a time.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub(super) enum Unposed {
    /// It is before the first pose or after the last.
    Outside,
    /// The poses around it are too far apart.
    Gap,
}

impl Trajectory {
    /// The longest selection of `poses` whose times increase, and the indices of the others.
    pub(super) fn new(poses: Vec<(u64, Isometry3<f64>)>, max_gap: u64) -> (Self, Vec<usize>) {
        let times: Vec<u64> = poses.iter().map(|(time, _)| *time).collect();
        // One time far ahead by mistake leaves itself out, not all poses after it.
        let mut kept = longest_increasing(&times).into_iter().peekable();
        let (mut in_order, mut out_of_order) = (Vec::with_capacity(kept.len()), Vec::new());
        for (index, pose) in poses.into_iter().enumerate() {
            if kept.next_if_eq(&index).is_some() {
                in_order.push(pose);
            } else {
                out_of_order.push(index);
            }
        }
        let poses = in_order;
        (Self { poses, max_gap }, out_of_order)
    }

    /// Number of poses.
    pub(super) fn len(&self) -> usize {
        self.poses.len()
    }

    /// Times of the first and the last pose.
    pub(super) fn span(&self) -> Option<(u64, u64)> {
        Some((self.poses.first()?.0, self.poses.last()?.0))
    }

    /// The pose at a time.
    pub(super) fn at(&self, time: u64) -> Result<Isometry3<f64>, Unposed> {
        let after = self.poses.partition_point(|(other, _)| *other < time);
        let (next_time, next) = self.poses.get(after).ok_or(Unposed::Outside)?;
        if *next_time == time {
            return Ok(*next);
        }
        let before = after
            .checked_sub(1)
            .and_then(|before| self.poses.get(before));
        let (last_time, last) = before.ok_or(Unposed::Outside)?;
        let gap = next_time - last_time;
        let share = (time - last_time) as f64 / gap as f64;
        // Half a turn within a gap cannot be interpolated.
        (gap <= self.max_gap)
            .then(|| last.try_lerp_slerp(next, share, 1e-9))
            .flatten()
            .ok_or(Unposed::Gap)
    }
}

/// Indices of the longest selection of values that increase.
fn longest_increasing(values: &[u64]) -> Vec<usize> {
    // Of the selections of each length, the smallest last value and its index; and the predecessor of each value.
    let mut ends: Vec<(u64, usize)> = Vec::new();
    let mut before: Vec<Option<usize>> = Vec::with_capacity(values.len());
    for (index, &value) in values.iter().enumerate() {
        // Bisection, because longer selections end in larger values.
        let length = ends.partition_point(|(end, _)| *end < value);
        let shorter = length.checked_sub(1).and_then(|shorter| ends.get(shorter));
        before.push(shorter.map(|(_, index)| *index));
        match ends.get_mut(length) {
            Some(end) if value < end.0 => *end = (value, index),
            Some(_) => {}
            None => ends.push((value, index)),
        }
    }
    let last = ends.last().map(|(_, index)| *index);
    let chain = std::iter::successors(last, |index| *before.get(*index)?);
    let mut selection: Vec<usize> = chain.collect();
    selection.reverse();
    selection
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_longest_increasing_selection_is_found() {
        assert_eq!(longest_increasing(&[]), Vec::<usize>::new());
        assert_eq!(longest_increasing(&[5, 1, 2, 9, 3, 3, 4]), [1, 2, 4, 6]);
        assert_eq!(longest_increasing(&[3, 2, 1]), [2]);
    }
}
