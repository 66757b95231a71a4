//! Ticks of which something has come but not everything: truth, result and poses come in any order.

use std::collections::BTreeMap;

use protocol::{CavId, Detections, PoseEstimate, Stamp, Truth};

/// Ticks that may still be waiting for something: at 10 Hz six seconds, longer than any detection takes.
pub(super) const MOST_OPEN: usize = 64;

/// What has come of one tick so far.
#[derive(Default)]
pub(super) struct Tick {
    /// What was there, and when it was published, nanoseconds.
    pub(super) truth: Option<(u64, Truth)>,
    /// What the ego makes of it, and when that was published, nanoseconds.
    pub(super) result: Option<(u64, Detections)>,
    /// Where the vehicles believe to be.
    pub(super) poses: Vec<(CavId, PoseEstimate)>,
    /// When these were published, nanoseconds.
    pub(super) posed_nanos: Vec<u64>,
}

/// What comes of a tick.
pub(super) enum Part {
    Truth(Truth),
    Result(Detections),
    Pose(PoseEstimate),
}

/// The ticks that are open, by capture time.
#[derive(Default)]
pub(super) struct OpenTicks {
    open: BTreeMap<u64, Tick>,
    closed_until: Option<u64>,
}

impl OpenTicks {
    /// Adds a part to its tick: the first of its kind counts, and a closed tick stays closed. The oldest tick makes
    /// room where too many are open, and is returned with its capture time.
    pub(super) fn add(&mut self, stamp: &Stamp, part: Part) -> Option<(u64, Tick)> {
        let capture_nanos = stamp.capture_nanos;
        if self.closed_until.is_some_and(|closed| capture_nanos <= closed) {
            return None;
        }
        let is_full = self.open.len() >= MOST_OPEN && !self.open.contains_key(&capture_nanos);
        let closed = if is_full { self.close_oldest() } else { None };
        let tick = self.open.entry(capture_nanos).or_default();
        match part {
            Part::Truth(truth) => {
                tick.truth.get_or_insert((stamp.publish_nanos, truth));
            }
            Part::Result(result) => {
                tick.result.get_or_insert((stamp.publish_nanos, result));
            }
            Part::Pose(estimate) => {
                if tick.poses.iter().all(|(known, _)| *known != stamp.cav) {
                    tick.poses.push((stamp.cav.clone(), estimate));
                    tick.posed_nanos.push(stamp.publish_nanos);
                }
            }
        }
        closed
    }

    /// Takes the oldest tick out.
    pub(super) fn close_oldest(&mut self) -> Option<(u64, Tick)> {
        let (capture_nanos, tick) = self.open.pop_first()?;
        self.closed_until = Some(capture_nanos);
        Some((capture_nanos, tick))
    }

    #[cfg(test)]
    pub(super) fn len(&self) -> usize {
        self.open.len()
    }
}
