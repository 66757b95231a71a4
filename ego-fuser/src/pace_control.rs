//! Pace control: where a machine cannot keep up, answers come less often instead of later.
//!
//! The controller counts overloaded frames: the own agent left a sweep out, or a frame waited for another one. Too many
//! of them lengthen the interval by one sweep; a while without any shortens it again. Failed attempts double that while.

use std::collections::VecDeque;
use std::time::{Duration, Instant};

use protocol::Pace;

/// Number of frames that are judged together.
const WINDOW: usize = 10;
/// Overloaded frames among them that lengthen the interval.
const TOO_MANY: usize = 3;
/// Longest interval.
const MAX_INTERVAL: Duration = Duration::from_secs(1);
/// First and longest time without an overloaded frame after which the interval is shortened.
const PATIENCE: [Duration; 2] = [Duration::from_secs(5), Duration::from_secs(80)];

/// Controller of an ego's pace.
#[derive(Debug)]
pub(crate) struct PaceControl {
    /// Shortest interval between two sweeps of the own agent so far, nanoseconds.
    period_nanos: Option<u64>,
    /// Sweeps per interval.
    step: u64,
    last_nanos: Option<u64>,
    overloaded: VecDeque<bool>,
    /// Time of the last overloaded frame or change.
    quiet_since: Instant,
    shortened_at: Option<Instant>,
    patience: Duration,
}

impl PaceControl {
    /// Controller that begins with every sweep.
    #[must_use]
    pub(crate) fn new(now: Instant) -> Self {
        Self {
            period_nanos: None,
            step: 1,
            last_nanos: None,
            overloaded: VecDeque::new(),
            quiet_since: now,
            shortened_at: None,
            patience: PATIENCE[0],
        }
    }

    /// Judges a frame of the own agent that waited for another one. Returns the pace if that changes.
    pub(crate) fn judge(
        &mut self,
        capture_nanos: u64,
        waited: Duration,
        now: Instant,
    ) -> Option<Pace> {
        let gap_nanos = self
            .last_nanos
            .replace(capture_nanos)
            .and_then(|last| capture_nanos.checked_sub(last));
        // The first frame, or one of a scene that has restarted.
        let gap_nanos = gap_nanos.filter(|gap| *gap > 0)?;
        let period_nanos = self
            .period_nanos
            .map_or(gap_nanos, |period| period.min(gap_nanos));
        self.period_nanos = Some(period_nanos);
        let interval_nanos = period_nanos.saturating_mul(self.step);
        let has_waited = waited > Duration::from_nanos(period_nanos / 2);
        let is_overloaded =
            has_waited || gap_nanos > interval_nanos.saturating_add(period_nanos / 2);
        if is_overloaded {
            self.quiet_since = now;
        }
        self.overloaded.push_back(is_overloaded);
        if self.overloaded.len() > WINDOW {
            self.overloaded.pop_front();
        }
        let step = self.next_step(period_nanos, now)?;
        self.overloaded.clear();
        self.quiet_since = now;
        self.step = step;
        let interval_nanos = if step == 1 {
            0
        } else {
            period_nanos.saturating_mul(step)
        };
        Some(Pace {
            interval_nanos,
            phase_nanos: capture_nanos,
        })
    }

    /// Another number of sweeps per interval, if it is time for one.
    fn next_step(&mut self, period_nanos: u64, now: Instant) -> Option<u64> {
        let count = self
            .overloaded
            .iter()
            .filter(|is_overloaded| **is_overloaded)
            .count();
        let longer = Duration::from_nanos(period_nanos.saturating_mul(self.step + 1));
        if count >= TOO_MANY && longer <= MAX_INTERVAL {
            let has_failed = self
                .shortened_at
                .take()
                .is_some_and(|at| now < at + PATIENCE[0]);
            self.patience = if has_failed {
                (2 * self.patience).min(PATIENCE[1])
            } else {
                PATIENCE[0]
            };
            return Some(self.step + 1);
        }
        let is_quiet = now >= self.quiet_since + self.patience;
        (self.step > 1 && is_quiet).then(|| {
            self.shortened_at = Some(now);
            self.step - 1
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const SWEEP_NANOS: u64 = 100_000_000;

    fn waited(is_long: bool) -> Duration {
        Duration::from_millis(if is_long { 60 } else { 40 })
    }

    /// A machine that needs `needed` sweep periods for a frame; the intervals of the paces that its ego publishes.
    fn intervals(needed: u64, seconds: u64) -> Vec<u64> {
        let start = Instant::now();
        let mut control = PaceControl::new(start);
        let (mut pace, mut free_at, mut last, mut changes) =
            (Pace::EVERY_SWEEP, 0, None, Vec::new());
        for sweep in 0..seconds * 10 {
            let capture_nanos = sweep * SWEEP_NANOS;
            let interval = pace.interval_of(capture_nanos);
            let is_due = interval.is_none() || interval != last;
            if !is_due || sweep < free_at {
                continue;
            }
            last = interval;
            free_at = sweep + needed;
            let now = start + Duration::from_nanos(capture_nanos);
            if let Some(next) = control.judge(capture_nanos, Duration::ZERO, now) {
                pace = next;
                last = next.interval_of(capture_nanos);
                changes.push(next.interval_nanos / SWEEP_NANOS);
            }
        }
        changes
    }

    #[test]
    fn a_machine_that_keeps_up_never_changes_its_pace() {
        assert_eq!(intervals(1, 60), [0; 0]);
    }

    #[test]
    fn a_frame_that_waits_now_and_then_is_no_overload() {
        let start = Instant::now();
        let mut control = PaceControl::new(start);
        for sweep in 0..100u64 {
            let now = start + Duration::from_millis(100 * sweep);
            assert_eq!(
                control.judge(sweep * SWEEP_NANOS, waited(sweep % 6 == 0), now),
                None
            );
        }
    }

    #[test]
    fn waiting_frames_slow_the_fleet_and_quiet_ones_let_it_try_again_less_and_less_often() {
        let start = Instant::now();
        let mut control = PaceControl::new(start);
        let (mut sweep, mut step, mut tries) = (0, 1, Vec::new());
        while sweep < 3000 {
            let now = start + Duration::from_millis(100 * sweep);
            // Every sweep is too much, every second one is not.
            if let Some(pace) =
                control.judge(sweep * SWEEP_NANOS, waited(step == 1 && sweep > 0), now)
            {
                step = (pace.interval_nanos / SWEEP_NANOS).max(1);
                if step == 1 {
                    tries.push(sweep);
                }
                assert!(step <= 2);
            }
            sweep += step;
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
        let start = Instant::now();
        let mut control = PaceControl::new(start);
        for sweep in (0..50).rev() {
            assert_eq!(
                control.judge(sweep * SWEEP_NANOS, waited(true), start),
                None
            );
        }
    }
}
