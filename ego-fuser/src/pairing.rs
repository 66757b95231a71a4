//! Pairing: selects the message of each sender for a frame of the ego by capture time, not by arrival.
//!
//! A sender is a vehicle, or one of its streams. For each the newest message that is not younger than the ego's frame is taken, unless it is too old. Younger
//! messages wait for their frame. A message that served one frame may serve the next one too, if no newer one arrives
//! in time; it is counted as received once.

use std::collections::{BTreeMap, VecDeque};

use protocol::DropReason;

/// Limits of pairing.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct PairingConfig {
    /// A message captured longer before the ego's frame is not used, nanoseconds.
    pub max_age_nanos: u64,
    /// A message captured at most this long after the ego's frame still counts as of its time, nanoseconds: sensors of
    /// different vehicles are not synchronised.
    pub max_lead_nanos: u64,
    /// Messages that wait per sender at most.
    pub depth: usize,
}

/// Last steps between sweeps of the ego whose third shortest is their period: one odd step, and frames that are missing,
/// change nothing.
const STEPS: usize = 10;

/// Shortest period of a LiDAR, nanoseconds: sweeps that follow each other faster are repeated ones.
const SHORTEST_PERIOD_NANOS: u64 = 20_000_000;

impl PairingConfig {
    /// Messages of at most that age, half a frame of 10 Hz of lead, and at least eight messages: at 10 Hz all that may
    /// still be fused.
    pub fn with_max_age_nanos(max_age_nanos: u64) -> Self {
        Self {
            max_age_nanos,
            max_lead_nanos: 50_000_000,
            depth: usize::try_from(max_age_nanos / 100_000_000 + 4).map_or(8, |depth| depth.max(8)),
        }
    }
}

/// A message that will not be used, with the reason.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Dropped<K> {
    /// Its sender.
    pub sender: K,
    /// Its capture time, nanoseconds.
    pub capture_nanos: u64,
    /// Reason for which it is not used.
    pub reason: DropReason,
}

impl<K: Clone> Dropped<K> {
    fn of(sender: &K, capture_nanos: u64, reason: DropReason) -> Self {
        Self {
            sender: sender.clone(),
            capture_nanos,
            reason,
        }
    }
}

/// A message that belongs to the ego's frame.
#[derive(Debug, PartialEq)]
pub struct Paired<'a, K, T> {
    /// Its sender.
    pub sender: &'a K,
    /// Capture time of the ego's frame less that of the message, nanoseconds.
    pub age_nanos: i64,
    /// True if it has not served an earlier frame: then it counts as received now.
    pub is_first_use: bool,
    /// The message.
    pub message: &'a T,
}

/// Messages that wait for the ego's frame.
#[derive(Debug)]
pub struct Pairing<K, T> {
    config: PairingConfig,
    /// Largest lead of a message that counts as of the time of the ego's frame, nanoseconds.
    pub(crate) lead_nanos: u64,
    /// Last steps between sweeps of the ego, nanoseconds.
    steps_nanos: VecDeque<u64>,
    waiting: BTreeMap<K, VecDeque<Waiting<T>>>,
}

#[derive(Debug)]
struct Waiting<T> {
    capture_nanos: u64,
    is_used: bool,
    message: T,
}

impl<K: Ord + Clone, T> Pairing<K, T> {
    /// No messages yet.
    pub fn new(config: PairingConfig) -> Self {
        Self {
            config,
            lead_nanos: config.max_lead_nanos,
            steps_nanos: VecDeque::new(),
            waiting: BTreeMap::new(),
        }
    }

    /// Limits the lead to half the period of the ego's sweeps, the last of which followed after `step_nanos`: at 20 Hz a
    /// message of the sweep before is within 50 ms too.
    pub(crate) fn limit_lead(&mut self, step_nanos: u64) {
        if step_nanos < SHORTEST_PERIOD_NANOS {
            return;
        }
        self.steps_nanos.push_front(step_nanos);
        self.steps_nanos.truncate(STEPS);
        let mut sorted = Vec::from_iter(self.steps_nanos.iter().copied());
        sorted.sort_unstable();
        // The shorter ones: also where most frames have one missing before them, as at a lower pace.
        let count = sorted.len();
        let period_nanos = sorted[((count - 1) / 4).max(usize::from(count > 2))];
        self.lead_nanos = self.config.max_lead_nanos.min(period_nanos / 2);
    }

    /// Queues a message. The message that has to be dropped for it is returned: the message itself when it is a
    /// duplicate or older than one that served already, or the oldest of the queue when that is full.
    #[must_use = "what was dropped has to be counted"]
    pub fn insert(&mut self, sender: &K, capture_nanos: u64, message: T) -> Option<Dropped<K>> {
        let queue = self.waiting.entry(sender.clone()).or_default();
        if queue.iter().any(|held| held.capture_nanos == capture_nanos) {
            return Some(Dropped::of(sender, capture_nanos, DropReason::Duplicate));
        }
        let mut used = queue.iter().filter(|held| held.is_used);
        if used.any(|held| held.capture_nanos > capture_nanos) {
            return Some(Dropped::of(sender, capture_nanos, DropReason::Superseded));
        }
        // Messages may be reordered by the channel.
        let place = queue.partition_point(|held| held.capture_nanos < capture_nanos);
        let waiting = Waiting {
            capture_nanos,
            is_used: false,
            message,
        };
        queue.insert(place, waiting);
        if queue.len() <= self.config.depth.max(1) {
            return None;
        }
        // One that served a frame has been counted as received.
        let oldest = queue.pop_front().filter(|oldest| !oldest.is_used)?;
        let capture_nanos = oldest.capture_nanos;
        Some(Dropped::of(sender, capture_nanos, DropReason::Superseded))
    }

    /// The messages that belong to the ego's frame, by sender, and those that will never be used.
    pub fn pair(&mut self, ego_capture_nanos: u64) -> (Vec<Paired<'_, K, T>>, Vec<Dropped<K>>) {
        let latest = ego_capture_nanos.saturating_add(self.lead_nanos);
        let earliest = ego_capture_nanos.saturating_sub(self.config.max_age_nanos);
        let mut paired = Vec::new();
        let mut dropped = Vec::new();
        for (sender, queue) in &mut self.waiting {
            let due = queue.partition_point(|held| held.capture_nanos <= latest);
            let newest = due
                .checked_sub(1)
                .filter(|&newest| queue[newest].capture_nanos >= earliest);
            // All before the newest that is due have missed their frame; without one young enough, so have all.
            for held in queue.drain(..newest.unwrap_or(due)) {
                if !held.is_used {
                    let reason = match held.capture_nanos < earliest {
                        true => DropReason::Stale,
                        false => DropReason::Superseded,
                    };
                    dropped.push(Dropped::of(sender, held.capture_nanos, reason));
                }
            }
            if newest.is_some()
                && let Some(held) = queue.front_mut()
            {
                let is_first_use = !std::mem::replace(&mut held.is_used, true);
                // Negative for a message captured after the frame, within the lead.
                let age_nanos = ego_capture_nanos as i64 - held.capture_nanos as i64;
                paired.push(Paired {
                    sender,
                    age_nanos,
                    is_first_use,
                    message: &held.message,
                });
            }
        }
        (paired, dropped)
    }

    /// True if a sender's message for the ego's frame waits, or a later one: then this frame's own is lost, and waiting for
    /// it is useless.
    pub fn has_reached(&self, sender: &K, ego_capture_nanos: u64) -> bool {
        self.capture_times(sender)
            .any(|time| time.saturating_add(self.lead_nanos) >= ego_capture_nanos)
    }

    /// The capture times of messages of a sender that wait, oldest first.
    pub fn capture_times(&self, sender: &K) -> impl Iterator<Item = u64> + '_ {
        let queue = self.waiting.get(sender).into_iter().flatten();
        queue.map(|held| held.capture_nanos)
    }

    /// The clock of the scene was set back to `now_nanos`: removes messages of later times, except those up to `ahead_nanos`
    /// early. Returns the number of these that were never used, by sender.
    pub(crate) fn turn_back(&mut self, now_nanos: u64, ahead_nanos: u64) -> Vec<(K, usize)> {
        let latest = now_nanos.saturating_add(ahead_nanos);
        let queues = self.waiting.iter_mut().map(|(sender, queue)| {
            let later = queue.iter().filter(|held| held.capture_nanos > latest);
            let unused = later.filter(|held| !held.is_used).count();
            // One that served belongs to the run before, even if it is only a little later.
            let kept = |is_used| if is_used { now_nanos } else { latest };
            queue.retain(|held| held.capture_nanos <= kept(held.is_used));
            (sender.clone(), unused)
        });
        queues.collect()
    }

    /// Removes a sender that has left; returns the number of its messages that were never used.
    pub fn forget(&mut self, sender: &K) -> usize {
        let unused = self.unused(sender);
        self.waiting.remove(sender);
        unused
    }

    /// Messages of a sender that wait and were never used, at the end of a run: in flight in the message accounting.
    pub fn unused(&self, sender: &K) -> usize {
        let queue = self.waiting.get(sender).into_iter().flatten();
        queue.filter(|held| !held.is_used).count()
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;
    use protocol::CavId;

    use super::*;

    const FRAME: u64 = 100_000_000;

    fn cav(name: &str) -> CavId {
        CavId::new(name).unwrap()
    }

    fn pairing() -> Pairing<CavId, u64> {
        Pairing::new(PairingConfig::with_max_age_nanos(3 * FRAME))
    }

    fn ages(pairing: &mut Pairing<CavId, u64>, ego: u64) -> (Vec<i64>, Vec<DropReason>) {
        let (paired, dropped) = pairing.pair(ego);
        (
            paired.iter().map(|found| found.age_nanos).collect(),
            dropped.iter().map(|lost| lost.reason).collect(),
        )
    }

    #[test]
    fn a_scene_that_begins_anew_is_paired_from_its_first_frame() {
        let mut pairing = pairing();
        for frame in [50, 51] {
            assert_eq!(pairing.insert(&cav("a"), frame * FRAME, frame), None);
        }
        assert_eq!(ages(&mut pairing, 50 * FRAME), (vec![0], vec![]));
        let gone = pairing.turn_back(2 * FRAME, 20 * FRAME);
        assert_eq!(gone, [(cav("a"), 1)]);
        assert_eq!(pairing.insert(&cav("a"), 2 * FRAME, 2), None);
        assert_eq!(ages(&mut pairing, 2 * FRAME), (vec![0], vec![]));
    }

    #[test]
    fn at_20_hz_the_sweep_before_does_not_stand_in_for_the_one_awaited() {
        let mut pairing = pairing();
        assert_eq!(pairing.insert(&cav("a"), 10 * FRAME, 10), None);
        let next = 10 * FRAME + FRAME / 2;
        assert!(pairing.has_reached(&cav("a"), next));
        // A repeated sweep, and one of 20 Hz.
        for (step, has_reached) in [(1, true), (FRAME / 2, false)] {
            pairing.limit_lead(step);
            assert_eq!(
                pairing.has_reached(&cav("a"), next),
                has_reached,
                "{step} ns"
            );
        }
        assert_eq!(pairing.insert(&cav("a"), next, 11), None);
        // Of two sweeps within 50 ms each frame has its own.
        assert_eq!(ages(&mut pairing, 10 * FRAME).0, [0]);
        assert_eq!(ages(&mut pairing, next).0, [0]);
    }

    #[test]
    fn one_odd_step_and_missing_frames_leave_the_lead() {
        let lead_after = |steps: &[u64]| {
            let mut pairing = pairing();
            steps.iter().for_each(|step| pairing.limit_lead(*step));
            pairing.lead_nanos
        };
        let half = FRAME / 2;
        assert_eq!(lead_after(&[FRAME, half, FRAME]), half, "10 Hz");
        assert_eq!(lead_after(&[half, 700 * FRAME, half]), half / 2, "20 Hz");
        assert_eq!(lead_after(&[half, FRAME, half, FRAME]), half / 2, "gaps");
        let paced = [[FRAME, FRAME, half]; 4].concat();
        assert_eq!(lead_after(&paced), half / 2, "20 Hz at 6 of 10 sweeps");
        let slower = [[half; STEPS], [FRAME; STEPS]].concat();
        assert_eq!(lead_after(&slower), half, "the last steps count");
    }

    #[test]
    fn the_message_of_the_same_time_is_taken_whatever_came_last() {
        let mut pairing = pairing();
        for frame in [11, 10, 12] {
            assert_eq!(pairing.insert(&cav("a"), frame * FRAME, frame), None);
        }
        let (paired, dropped) = pairing.pair(11 * FRAME);
        assert_eq!(
            (
                *paired[0].message,
                paired[0].age_nanos,
                paired[0].is_first_use
            ),
            (11, 0, true)
        );
        assert_eq!(
            dropped
                .iter()
                .map(|lost| (lost.capture_nanos / FRAME, lost.reason))
                .collect::<Vec<_>>(),
            [(10, DropReason::Superseded)]
        );
        assert_eq!(ages(&mut pairing, 12 * FRAME), (vec![0], vec![]));
    }

    #[test]
    fn a_late_neighbour_serves_again_until_it_is_too_old() {
        let mut pairing = pairing();
        assert_eq!(pairing.insert(&cav("a"), 10 * FRAME, 10), None);
        for (frame, first) in [(10, true), (11, false), (13, false)] {
            let (paired, dropped) = pairing.pair(frame * FRAME);
            assert_eq!(
                (paired[0].age_nanos, paired[0].is_first_use),
                ((frame as i64 - 10) * FRAME as i64, first)
            );
            assert!(dropped.is_empty());
        }
        // It was received, so its removal is no loss.
        assert_eq!(ages(&mut pairing, 14 * FRAME), (vec![], vec![]));
        assert_eq!(pairing.unused(&cav("a")), 0);
    }

    #[test]
    fn a_message_that_was_never_young_enough_is_stale() {
        let mut pairing = pairing();
        assert_eq!(pairing.insert(&cav("a"), FRAME, 1), None);
        assert_eq!(
            ages(&mut pairing, 9 * FRAME),
            (vec![], vec![DropReason::Stale])
        );
    }

    #[test]
    fn the_future_waits_and_a_little_lead_counts() {
        let mut pairing = pairing();
        assert_eq!(pairing.insert(&cav("a"), 10 * FRAME + FRAME / 4, 1), None);
        assert_eq!(ages(&mut pairing, 9 * FRAME), (vec![], vec![]));
        assert_eq!(
            ages(&mut pairing, 10 * FRAME),
            (vec![-(FRAME as i64) / 4], vec![])
        );
    }

    #[test]
    fn duplicates_and_reordered_messages_are_distinguished() {
        let mut pairing = pairing();
        assert_eq!(pairing.insert(&cav("a"), 10 * FRAME, 10), None);
        assert_eq!(
            pairing.insert(&cav("a"), 10 * FRAME, 10).unwrap().reason,
            DropReason::Duplicate
        );
        let _ = pairing.pair(10 * FRAME);
        assert_eq!(
            pairing.insert(&cav("a"), 10 * FRAME, 10).unwrap().reason,
            DropReason::Duplicate
        );
        assert_eq!(
            pairing.insert(&cav("a"), 9 * FRAME, 9).unwrap().reason,
            DropReason::Superseded
        );
    }

    #[test]
    fn a_flood_pushes_the_oldest_out() {
        let mut pairing = pairing();
        let lost: Vec<_> = (0..20)
            .filter_map(|frame| pairing.insert(&cav("a"), frame * FRAME, frame))
            .collect();
        assert_eq!(lost.len(), 12);
        assert_eq!(pairing.capture_times(&cav("a")).next(), Some(12 * FRAME));
        assert_eq!(pairing.forget(&cav("a")), 8);
    }

    proptest! {
        /// Received, dropped and waiting add up to the input, for any messages in any order.
        #[test]
        fn the_accounting_balances(events in prop::collection::vec((0u64..40, 0u8..3, any::<bool>()), 0..200)) {
            let mut pairing = pairing();
            let (mut sent, mut received, mut lost) = (0, 0, 0);
            for (frame, sender, is_message) in events {
                if is_message {
                    sent += 1;
                    lost += usize::from(pairing.insert(&cav(&sender.to_string()), frame * FRAME, frame).is_some());
                } else {
                    let (paired, dropped) = pairing.pair(frame * FRAME);
                    received += paired.iter().filter(|found| found.is_first_use).count();
                    lost += dropped.len();
                }
            }
            let unused: usize = pairing.waiting.keys().map(|cav| pairing.unused(cav)).sum();
            prop_assert_eq!(sent, received + lost + unused);
        }
    }
}
