//! Schedule: order of ticks, and their capture times on the replay's clock.

use std::sync::Arc;

use serde::{Deserialize, Serialize};

use dataset::{Tick, period_nanos};

/// Period of a scene without one, as of a single tick, nanoseconds.
const SINGLE_TICK_PERIOD: u64 = 100_000_000;
/// Gap of capture time at a jump back, nanoseconds, by which vehicles see it: more than the 60 s over which a tracked pose
/// may be predicted. Object tracks and feature memories last for less.
const JUMP_NANOS: u64 = 61_000_000_000;
/// Longest jump back without a gap, nanoseconds: trackers follow one so short, and small scenes would be gaps for the most part.
const SHORT_JUMP_NANOS: u64 = 1_000_000_000;

/// One tick to be published.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Planned {
    /// Its index in the scenario's ticks.
    pub tick_index: usize,
    /// Capture time on the clock of the replay, nanoseconds: the recorded one until the first jump back.
    pub capture_nanos: u64,
    /// Part of the step to that time which takes no time: the gap of a jump back, nanoseconds.
    pub gap_nanos: u64,
}

/// State of a schedule.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Position {
    /// The next tick.
    pub next_tick: usize,
    /// Ticks left to play; `None`: to the end of the scene, or without end.
    pub left: Option<usize>,
    /// Shift of capture times, nanoseconds.
    pub shift_nanos: u64,
    /// Capture time of the last tick, nanoseconds.
    pub last_nanos: Option<u64>,
}

/// The order of ticks with seeking, looping and a limit. Iterating over a clone gives the ticks ahead.
///
/// Capture times always rise, as if the vehicles drove on: a receiver that pairs by capture time must not get one
/// twice. After a jump back (a loop, or a seek) all times are shifted so that the next tick follows the last, by a period
/// of the scene and, after more than a second, the gap by which vehicles end what they track.
#[derive(Debug, Clone)]
pub struct Schedule {
    captures: Arc<[u64]>,
    period_nanos: u64,
    repeats: bool,
    /// Its state.
    pub(super) position: Position,
}

impl Schedule {
    /// Begins at tick `first`; ends after `frames` ticks, or, unless it `repeats`, with the scene.
    pub fn new(ticks: &[Tick], first: usize, frames: Option<usize>, repeats: bool) -> Self {
        Self {
            captures: ticks.iter().map(|tick| tick.capture_nanos).collect(),
            period_nanos: period_nanos(ticks).unwrap_or(SINGLE_TICK_PERIOD),
            repeats,
            position: Position {
                next_tick: first,
                left: frames,
                shift_nanos: 0,
                last_nanos: None,
            },
        }
    }

    /// Resumes at the state of the previous process instance, with its capture times.
    pub fn resumed(self, position: Position) -> Self {
        Self { position, ..self }
    }

    /// The next ticks, at most `count`.
    pub fn ahead(&self, count: usize) -> Vec<usize> {
        let ahead = self.clone().take(count);
        ahead.map(|planned| planned.tick_index).collect()
    }
}

impl Iterator for Schedule {
    type Item = Planned;

    fn next(&mut self) -> Option<Planned> {
        if self.position.left == Some(0) {
            return None;
        }
        if self.position.next_tick >= self.captures.len() && self.repeats {
            self.position.next_tick = 0;
        }
        let tick_index = self.position.next_tick;
        let recorded = *self.captures.get(tick_index)?;
        let back_to = recorded.saturating_add(self.position.shift_nanos);
        let mut gap_nanos = 0;
        if let Some(last) = self.position.last_nanos
            && let Some(back_nanos) = last.checked_sub(back_to)
        {
            gap_nanos = JUMP_NANOS * u64::from(back_nanos > SHORT_JUMP_NANOS);
            let step_nanos = self.period_nanos.saturating_add(gap_nanos);
            self.position.shift_nanos = last.saturating_add(step_nanos).saturating_sub(recorded);
        }
        let capture_nanos = recorded.saturating_add(self.position.shift_nanos);
        self.position.next_tick += 1;
        self.position.left = self.position.left.map(|left| left - 1);
        self.position.last_nanos = Some(capture_nanos);
        Some(Planned {
            tick_index,
            capture_nanos,
            gap_nanos,
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn ticks(captures: &[u64]) -> Vec<Tick> {
        captures
            .iter()
            .map(|&capture_nanos| Tick {
                stem: capture_nanos.to_string(),
                capture_nanos,
            })
            .collect()
    }

    fn plan(schedule: impl IntoIterator<Item = Planned>, count: usize) -> Vec<(usize, u64)> {
        schedule
            .into_iter()
            .take(count)
            .map(|planned| (planned.tick_index, planned.capture_nanos))
            .collect()
    }

    #[test]
    fn a_scene_is_played_once() {
        let schedule = Schedule::new(&ticks(&[100, 200, 300]), 0, None, false);
        assert_eq!(plan(schedule, 9), [(0, 100), (1, 200), (2, 300)]);
        assert_eq!(
            plan(
                Schedule::new(&ticks(&[100, 200, 300]), 1, Some(1), false),
                9
            ),
            [(1, 200)]
        );
        assert_eq!(plan(Schedule::new(&[], 0, None, true), 9), []);
    }

    #[test]
    fn a_loop_drives_on() {
        let schedule = Schedule::new(&ticks(&[100, 200, 350]), 1, Some(6), true);
        assert_eq!(
            plan(schedule, 9),
            [(1, 200), (2, 350), (0, 475), (1, 575), (2, 725), (0, 850)]
        );
        assert_eq!(
            plan(Schedule::new(&ticks(&[7]), 0, None, true), 2),
            [(0, 7), (0, 100_000_007)]
        );
    }

    #[test]
    fn vehicles_see_a_long_jump_back_by_a_gap_that_takes_no_time() {
        const STEP: u64 = 100_000_000;
        let captures: Vec<u64> = (1..=12).map(|tick| tick * STEP).collect();
        let ticks = ticks(&captures);
        let mut schedule = Schedule::new(&ticks, 0, None, true);
        let gaps: Vec<u64> = { schedule.by_ref().take(36) }
            .map(|planned| planned.gap_nanos)
            .collect();
        for (tick, gap_nanos) in gaps.into_iter().enumerate() {
            let is_lap = tick > 0 && tick % 12 == 0;
            assert_eq!(gap_nanos, if is_lap { JUMP_NANOS } else { 0 }, "{tick}");
        }
        let last = 36 * STEP + 2 * JUMP_NANOS;
        assert_eq!(plan(&mut schedule, 1), [(0, last + STEP + JUMP_NANOS)]);
        // A second back is a short jump.
        let short = Schedule::new(&ticks[..11], 10, None, true);
        assert_eq!(plan(short, 2), [(10, 11 * STEP), (0, 12 * STEP)]);
    }

    #[test]
    fn a_restarted_schedule_resumes_where_the_first_ended() {
        let ticks = ticks(&[100, 200, 350]);
        let whole = Schedule::new(&ticks, 1, Some(9), true);
        let mut first = whole.clone();
        let mut seen = plan(first.by_ref().take(4).collect::<Vec<_>>(), 9);
        let second = Schedule::new(&ticks, 0, None, true).resumed(first.position);
        seen.extend(plan(second, 9));
        assert_eq!(seen, plan(whole, 9));
    }

    #[test]
    fn a_jump_back_never_repeats_a_time_and_one_ahead_keeps_the_recorded() {
        let mut schedule = Schedule::new(&ticks(&[100, 200, 300, 400]), 0, None, false);
        assert_eq!(
            schedule.next().map(|planned| planned.capture_nanos),
            Some(100)
        );
        schedule.position.next_tick = 2;
        assert_eq!(schedule.ahead(3), [2, 3]);
        assert_eq!(
            schedule.next().map(|planned| planned.capture_nanos),
            Some(300)
        );
        schedule.position.next_tick = 0;
        assert_eq!(plan(schedule, 2), [(0, 400), (1, 500)]);
    }
}
