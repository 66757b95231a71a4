//! Ticks with some but not all messages: truth, result and poses arrive in any order.

use std::collections::BTreeMap;

use protocol::{CavId, Detections, PoseEstimate, Stamp, Truth};

/// Largest number of incomplete ticks: at 10 Hz six seconds, longer than any detection takes.
pub(super) const MOST_OPEN: usize = 64;

/// Messages of one tick so far.
#[derive(Default)]
pub(super) struct OpenTick {
    /// Ground truth and its time of publication, nanoseconds.
    pub(super) truth: Option<(u64, Truth)>,
    /// Result of the ego and its time of publication, nanoseconds.
    pub(super) result: Option<(u64, Detections)>,
    /// Pose estimates of the vehicles.
    pub(super) poses: Vec<(CavId, PoseEstimate)>,
    /// Time of publication of that of the ego, nanoseconds.
    pub(super) posed_nanos: Option<u64>,
}

/// Incomplete ticks, by capture time.
#[derive(Default)]
pub(super) struct OpenTicks {
    pub(super) open: BTreeMap<u64, OpenTick>,
    closed_until: Option<u64>,
}

impl OpenTicks {
    /// Lets `fill` add a message to its tick: the first of its kind counts, and a closed tick stays closed. If too many
    /// are open, the oldest tick is removed and returned with its capture time.
    pub(super) fn add(
        &mut self,
        stamp: &Stamp,
        fill: impl FnOnce(&mut OpenTick),
    ) -> Option<(u64, OpenTick)> {
        let capture_nanos = stamp.capture_nanos;
        if { self.closed_until }.is_some_and(|closed| capture_nanos <= closed) {
            return None;
        }
        fill(self.open.entry(capture_nanos).or_default());
        // The oldest may be this one: closed ticks stay in order.
        let is_full = self.open.len() > MOST_OPEN;
        is_full.then(|| self.close_oldest()).flatten()
    }

    /// Removes the oldest tick.
    pub(super) fn close_oldest(&mut self) -> Option<(u64, OpenTick)> {
        let (capture_nanos, tick) = self.open.pop_first()?;
        self.closed_until = Some(capture_nanos);
        Some((capture_nanos, tick))
    }
}
