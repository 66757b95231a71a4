//! Pace control: where a machine cannot keep up, answers come less often instead of later.
//!
//! The controller counts overloaded frames: the own agent left a sweep out, or a frame waited for another one. Too many
//! of them lower the share of sweeps that the fleet computes to what it achieved, in tenths; a while without any raises
//! it by a tenth. Failed attempts double that while.

use std::collections::VecDeque;

use protocol::Pace;

use crate::capture_clock::JUMP_NANOS;

/// Shortest intervals whose longest is the period: fewer are odd steps of a recording or of a sensor.
const SHORTEST: usize = 3;
/// Number of frames that are judged together.
const WINDOW: usize = 10;
/// Overloaded frames among them that lower the share.
const TOO_MANY: usize = 3;
/// Denominator of the share.
const TENTHS: u8 = 10;
/// Largest step downwards, tenths: the first frames of a run are slower than others.
const MAX_STEP: u8 = 2;
/// Longest mean interval, nanoseconds.
const MAX_INTERVAL_NANOS: u64 = 1_000_000_000;
/// Period at which the pace is repeated, nanoseconds: for agents that join late, and so that a slower ego of the fleet
/// does not set the pace of one that keeps up.
const REPEAT_NANOS: u64 = 1_000_000_000;
/// First and longest time without an overloaded frame after which the share is raised, nanoseconds.
const CALM_NANOS: [u64; 2] = [5_000_000_000, 80_000_000_000];

/// Controller of an ego's pace.
#[derive(Debug)]
pub(crate) struct PaceControl {
    /// The [`SHORTEST`] intervals between two sweeps of the own agent so far, nanoseconds, ascending.
    shortest_nanos: Vec<u64>,
    pace: Pace,
    /// Time at which the pace was published, nanoseconds.
    published_nanos: Option<u64>,
    last_nanos: Option<u64>,
    /// The frames since the last change, each with the capture time since the frame before, nanoseconds, and whether
    /// it was overloaded.
    judged: VecDeque<(u64, bool)>,
    /// Time of the last overloaded frame or change, nanoseconds.
    quiet_since_nanos: u64,
    raised_at_nanos: Option<u64>,
    calm_nanos: u64,
}

impl PaceControl {
    /// Controller that begins with every sweep.
    pub(crate) fn new() -> Self {
        Self {
            shortest_nanos: Vec::new(),
            pace: Pace::EVERY_SWEEP,
            published_nanos: None,
            last_nanos: None,
            judged: VecDeque::new(),
            quiet_since_nanos: 0,
            raised_at_nanos: None,
            calm_nanos: CALM_NANOS[0],
        }
    }

    /// Judges a frame of the own agent that waited for another one. Returns the pace if that changes.
    pub(crate) fn judge(
        &mut self,
        capture_nanos: u64,
        waited_nanos: u64,
        now_nanos: u64,
    ) -> Option<Pace> {
        let last_nanos = self.last_nanos.replace(capture_nanos);
        // The first frame, or one of a scene that has restarted.
        let last_nanos = last_nanos.filter(|last| *last < capture_nanos)?;
        let gap_nanos = capture_nanos - last_nanos;
        if gap_nanos > JUMP_NANOS {
            // The scene has jumped: no sweep was left out.
            self.shortest_nanos.clear();
            return None;
        }
        self.shortest_nanos.push(gap_nanos);
        self.shortest_nanos.sort_unstable();
        self.shortest_nanos.truncate(SHORTEST);
        let period_nanos = *self.shortest_nanos.last()?;
        let intervals = [capture_nanos, last_nanos].map(|nanos| self.pace.interval_of(nanos));
        // Agents compute one sweep of each interval, so that a skipped interval is a sweep left out.
        // At every sweep there are no intervals: a gap of one and a half periods is one.
        let is_left_out = match intervals {
            [Some(interval), Some(last)] => interval > last + 1,
            _ => gap_nanos > period_nanos.saturating_add(period_nanos / 2),
        };
        // Between two sweeps that are left out, frames wait for each other.
        let is_every_sweep = self.pace == Pace::EVERY_SWEEP;
        let longest_nanos = period_nanos / if is_every_sweep { 2 } else { 1 };
        let is_overloaded = is_left_out || waited_nanos > longest_nanos;
        if is_overloaded {
            self.quiet_since_nanos = now_nanos;
        }
        self.judged.push_back((gap_nanos, is_overloaded));
        if self.judged.len() > WINDOW {
            self.judged.pop_front();
        }
        let computed = self.next_share(period_nanos, now_nanos)?;
        // Frames of the old pace say nothing about the new one.
        self.judged.clear();
        self.quiet_since_nanos = now_nanos;
        self.pace = if computed == TENTHS {
            Pace::EVERY_SWEEP
        } else {
            Pace {
                period_nanos,
                phase_nanos: capture_nanos,
                computed,
                of: TENTHS,
            }
        };
        self.published_nanos = Some(now_nanos);
        let Pace { computed, of, .. } = self.pace;
        tracing::info!(
            capture_nanos,
            "the pace of the fleet changes to {computed} of {of} sweeps"
        );
        Some(self.pace)
    }

    /// The pace, if it is time to publish it again.
    pub(crate) fn repeat(&mut self, now_nanos: u64) -> Option<Pace> {
        let since_nanos = *self.published_nanos.get_or_insert(now_nanos);
        if now_nanos < since_nanos.saturating_add(REPEAT_NANOS) {
            return None;
        }
        self.published_nanos = Some(now_nanos);
        Some(self.pace)
    }

    /// Another share, tenths, if it is time for one.
    fn next_share(&mut self, period_nanos: u64, now_nanos: u64) -> Option<u8> {
        let share = self.pace.computed * (TENTHS / self.pace.of);
        let overloaded = self.judged.iter().filter(|frame| frame.1);
        let count = overloaded.count();
        // Tenths at which computed sweeps are MAX_INTERVAL_NANOS apart on average.
        let lowest = period_nanos.saturating_mul(u64::from(TENTHS)) / MAX_INTERVAL_NANOS;
        let lowest = u8::try_from(lowest.max(1)).unwrap_or(TENTHS);
        if count >= TOO_MANY && share > lowest {
            let raised_at = self.raised_at_nanos.take();
            let [shortest, longest] = CALM_NANOS;
            let has_failed = raised_at.is_some_and(|at| now_nanos < at.saturating_add(shortest));
            // Overloaded soon after a raise: the next one has to wait twice as long.
            self.calm_nanos = match has_failed {
                true => (2 * self.calm_nanos).min(longest),
                false => shortest,
            };
            let least = share.saturating_sub(MAX_STEP).max(lowest);
            return Some(self.achieved_share(period_nanos).clamp(least, share - 1));
        }
        let is_quiet = now_nanos >= self.quiet_since_nanos.saturating_add(self.calm_nanos);
        (share < TENTHS && is_quiet).then(|| {
            self.raised_at_nanos = Some(now_nanos);
            share + 1
        })
    }

    /// Share of the sweeps that were computed since the last change, whole tenths.
    fn achieved_share(&self, period_nanos: u64) -> u8 {
        let span_nanos: u64 = self.judged.iter().map(|(gap, _)| gap).sum();
        let frames = self.judged.len() as u64;
        let share = (u64::from(TENTHS) * frames).saturating_mul(period_nanos) / span_nanos.max(1);
        u8::try_from(share).unwrap_or(TENTHS)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const SWEEP_NANOS: u64 = 100_000_000;

    fn nanos(ms: u64) -> u64 {
        ms * 1_000_000
    }

    /// A machine with one place for a waiting sweep that needs `needed_ms` for a frame: the sweeps that it answers, each
    /// with its waiting time.
    fn answered(needed_ms: u64, seconds: u64) -> Vec<(u64, u64)> {
        let mut control = PaceControl::new();
        let (mut pace, mut last, mut free_at_ms) = (Pace::EVERY_SWEEP, None, 0);
        let (mut waiting, mut answers) = (None::<u64>, Vec::new());
        for time_ms in 0..seconds * 1000 {
            if time_ms % 100 == 0 {
                let interval = pace.interval_of(time_ms * 1_000_000);
                if interval.is_none() || interval != last {
                    (last, waiting) = (interval, Some(time_ms));
                }
            }
            if let Some(captured_ms) = waiting.take_if(|_| time_ms >= free_at_ms) {
                let waited_ms = time_ms - captured_ms;
                free_at_ms = time_ms + needed_ms;
                answers.push((captured_ms / 100, waited_ms));
                let [captured, waited, now] = [captured_ms, waited_ms, time_ms].map(nanos);
                if let Some(next) = control.judge(captured, waited, now) {
                    pace = next;
                    last = pace.interval_of(captured_ms * 1_000_000);
                }
            }
        }
        answers
    }

    #[test]
    fn a_machine_that_keeps_up_answers_every_sweep() {
        assert_eq!(answered(100, 60).len(), 600);
    }

    #[test]
    fn a_machine_that_misses_the_rate_by_little_answers_little_less() {
        // Milliseconds of work per 100 ms sweep, and frames that it has time for in a minute.
        for (needed_ms, capacity) in [
            (105, 571),
            (112, 535),
            (120, 500),
            (150, 400),
            (240, 250),
            (700, 85),
        ] {
            let answers = answered(needed_ms, 60);
            let count = answers.len();
            assert!(
                count * 100 >= capacity * 85 && count <= capacity + 1,
                "{needed_ms} ms: {count} of {capacity}"
            );
            let settled = &answers[count / 2..];
            let gaps = settled.windows(2).map(|pair| pair[1].0 - pair[0].0);
            let floor = needed_ms / 100;
            let uneven = gaps
                .filter(|gap| !(floor..=floor + 2).contains(gap))
                .count();
            assert!(uneven * 10 <= count, "{needed_ms} ms: {uneven} of {count}");
            let mut waits_ms: Vec<_> = settled.iter().map(|(_, waited)| *waited).collect();
            waits_ms.sort();
            assert!(
                waits_ms[waits_ms.len() / 2] <= 100,
                "{needed_ms} ms: {waits_ms:?}"
            );
        }
    }

    #[test]
    fn eight_of_ten_sweeps_are_answered_by_a_machine_that_has_time_for_eight_point_three() {
        let answers = answered(120, 6);
        assert!(
            (46..=50).contains(&answers.len()),
            "{} of 60",
            answers.len()
        );
    }

    #[test]
    fn a_frame_that_waits_now_and_then_is_no_overload() {
        let mut control = PaceControl::new();
        for sweep in 0..100u64 {
            let now = sweep * SWEEP_NANOS;
            let waited = nanos(if sweep % 6 == 0 { 60 } else { 40 });
            assert_eq!(control.judge(sweep * SWEEP_NANOS, waited, now), None);
        }
    }

    #[test]
    fn one_short_step_does_not_lower_the_pace() {
        let mut control = PaceControl::new();
        for sweep in 0..60u64 {
            // From the tenth sweep on half a period earlier.
            let now = sweep * SWEEP_NANOS + nanos(if sweep < 10 { 50 } else { 0 });
            assert_eq!(control.judge(now, nanos(40), now), None, "{sweep}");
        }
    }

    #[test]
    fn laps_of_a_scene_are_no_overload() {
        let (mut control, mut capture_nanos) = (PaceControl::new(), 0);
        for sweep in 0..60u64 {
            capture_nanos += SWEEP_NANOS + if sweep % 3 == 0 { 61 * nanos(1000) } else { 0 };
            let changed = control.judge(capture_nanos, nanos(40), sweep * SWEEP_NANOS);
            assert_eq!(changed, None, "{sweep}");
        }
    }

    #[test]
    fn failed_attempts_become_less_and_less_frequent() {
        let mut control = PaceControl::new();
        let (mut share, mut tries) = (10, Vec::new());
        for sweep in 0..3000 {
            let now = sweep * SWEEP_NANOS;
            // Every sweep is too much, nine of ten are not.
            let waited = nanos(if share == 10 { 60 } else { 40 });
            if let Some(pace) = control.judge(sweep * SWEEP_NANOS, waited, now) {
                share = pace.computed * (TENTHS / pace.of);
                tries.extend((share == 10).then_some(sweep));
                assert!(share >= 9);
            }
        }
        let pauses: Vec<u64> = tries.windows(2).map(|pair| pair[1] - pair[0]).collect();
        assert!(
            pauses.windows(2).all(|pair| pair[1] >= pair[0]) && pauses[0] >= 50,
            "{pauses:?}"
        );
        assert!(pauses.last().unwrap() > &400, "{pauses:?}");
    }

    #[test]
    fn a_restarted_scene_and_a_first_frame_are_not_judged() {
        let mut control = PaceControl::new();
        for sweep in (0..50).rev() {
            assert_eq!(control.judge(sweep * SWEEP_NANOS, nanos(60), 0), None);
        }
    }
}
