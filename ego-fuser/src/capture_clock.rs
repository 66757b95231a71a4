//! Capture clocks: estimates by how much each neighbour's capture times are ahead of the ego's, and corrects them.
//!
//! Agents report when their sweeps arrived. Sweeps that arrive at one moment were captured at one moment, so their
//! capture times differ by the offset of the clocks. Compute times and links do not matter, as only the arrival at the
//! agent counts. The ego's own sweeps give capture time over arrival time: a scene that is played slower or faster
//! than real time is no offset.

use std::collections::{BTreeMap, VecDeque};

use protocol::CavId;
use protocol::message::NeighbourState;
use serde::{Deserialize, Serialize};

/// Offset beyond which a clock is named and corrected, nanoseconds.
const LIMIT_NANOS: i64 = 50_000_000;
/// Spread of the samples beyond which no correction is possible, nanoseconds.
const UNSTEADY_NANOS: i64 = 500_000_000;
/// Time that an estimate looks back, nanoseconds.
const WINDOW_NANOS: u64 = 1_300_000_000;
/// Time in which sweeps that waited during a pause of the ego's own agent arrive after it, nanoseconds.
const BACKLOG_NANOS: u64 = 500_000_000;
/// Step between capture times of own sweeps beyond which the scene has jumped, nanoseconds: a replay that jumps back leaves
/// a gap of 61 s.
pub(crate) const JUMP_NANOS: u64 = 30_000_000_000;
/// Largest number of sweeps and of samples that are kept of a vehicle.
const MAX_KEPT: usize = 64;
/// Largest number of vehicles.
const MAX_VEHICLES: usize = 128;

/// A sweep of a vehicle.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct SweepTime {
    /// Capture time as the vehicle states it, nanoseconds.
    pub capture_nanos: u64,
    /// Arrival at the vehicle's agent on the ego's clock, nanoseconds.
    pub arrived_nanos: u64,
}

/// Capture clocks of the neighbours.
#[derive(Debug)]
pub struct CaptureClocks {
    /// Samples of an estimate at least.
    fewest: usize,
    /// The ego's own sweeps, by arrival.
    own: VecDeque<SweepTime>,
    /// Arrival of the first own sweep after the last pause of its agent, nanoseconds.
    resumed_nanos: u64,
    neighbours: BTreeMap<CavId, NeighbourClock>,
}

#[derive(Debug, Default)]
struct NeighbourClock {
    /// Sweeps that arrived after the ego's newest.
    pending: VecDeque<SweepTime>,
    /// Arrival, nanoseconds, and how far the capture time is ahead, nanoseconds.
    samples: VecDeque<(u64, i64)>,
    /// Offset that is subtracted from capture times, nanoseconds.
    offset_nanos: i64,
    is_unsteady: bool,
}

impl CaptureClocks {
    /// Clocks without a sweep. Where arrivals are exact, as in simulation time, one sweep of a vehicle makes an
    /// estimate; where they are measured, three do.
    pub fn new(has_exact_arrivals: bool) -> Self {
        Self {
            fewest: if has_exact_arrivals { 1 } else { 3 },
            own: VecDeque::new(),
            resumed_nanos: u64::MAX,
            neighbours: BTreeMap::new(),
        }
    }

    /// Adds a sweep of the ego's own vehicle.
    pub fn note_own(&mut self, sweep: SweepTime) {
        if sweep.arrived_nanos.abs_diff(self.resumed_nanos) < BACKLOG_NANOS {
            return;
        }
        match self.own.back() {
            Some(last) if last.arrived_nanos == sweep.arrived_nanos => return,
            // The system clock was set back.
            Some(last) if last.arrived_nanos > sweep.arrived_nanos => self.own.clear(),
            Some(last) if last.capture_nanos.abs_diff(sweep.capture_nanos) > JUMP_NANOS => {
                self.own.clear();
            }
            // Neighbours' sweeps of a pause cannot be compared, nor those beside own ones that waited.
            Some(last) if self.is_pause(last, &sweep) => {
                self.own.clear();
                self.resumed_nanos = sweep.arrived_nanos;
                return;
            }
            _ => {}
        }
        self.own.push_back(sweep);
        if self.own.len() > MAX_KEPT {
            self.own.pop_front();
        }
    }

    /// Adds a sweep of a neighbour.
    pub fn note(&mut self, cav: &CavId, sweep: SweepTime) {
        if self.neighbours.len() >= MAX_VEHICLES && !self.neighbours.contains_key(cav) {
            return;
        }
        let clock = self.neighbours.entry(cav.clone()).or_default();
        clock.pending.push_back(sweep);
        if clock.pending.len() > MAX_KEPT {
            clock.pending.pop_front();
        }
    }

    /// Estimates anew and logs what changes. Returns the neighbours whose capture times are corrected otherwise than
    /// before: their waiting messages belong to other frames.
    pub fn update(&mut self) -> Vec<CavId> {
        // At least 1: errors of arrival times grow with it.
        let pace = self.pace().unwrap_or(1.0).clamp(1.0, 100.0);
        let (newest, mut changed) = (self.own.back(), Vec::new());
        for (cav, clock) in &mut self.neighbours {
            // Interpolation needs an own sweep of this time or later, which a later report brings.
            while let Some(sweep) = clock.pending.pop_front_if(|sweep| {
                newest.is_some_and(|own| own.arrived_nanos >= sweep.arrived_nanos)
            }) {
                if let Some(own_nanos) = own_capture(&self.own, sweep.arrived_nanos) {
                    let ahead = i128::from(sweep.capture_nanos) - own_nanos;
                    let ahead = ahead.clamp(i64::MIN.into(), i64::MAX.into());
                    clock.add(sweep.arrived_nanos, ahead as i64);
                }
            }
            if clock.samples.len() >= self.fewest && clock.judge(cav, pace) {
                changed.push(cav.clone());
            }
        }
        changed
    }

    /// A neighbour's capture time on the ego's clock, nanoseconds; `None` while its clock is too unsteady.
    pub fn corrected(&self, cav: &CavId, capture_nanos: u64) -> Option<u64> {
        match self.neighbours.get(cav) {
            Some(clock) if clock.is_unsteady => None,
            Some(clock) => {
                // In 128 bits: neither u64 nor i64 holds every difference of the two.
                let corrected = i128::from(capture_nanos) - i128::from(clock.offset_nanos);
                Some(u64::try_from(corrected.max(0)).unwrap_or(u64::MAX))
            }
            None => Some(capture_nanos),
        }
    }

    /// Adds the offsets that are corrected to the states of neighbours, also of those without a message.
    pub fn describe(&self, states: &mut Vec<NeighbourState>) {
        for (cav, clock) in &self.neighbours {
            if clock.offset_nanos == 0 {
                continue;
            }
            let capture_offset_s = Some(clock.offset_nanos as f64 / 1e9);
            match states.iter_mut().find(|state| state.cav == *cav) {
                Some(state) => state.capture_offset_s = capture_offset_s,
                None => states.push(NeighbourState {
                    capture_offset_s,
                    ..NeighbourState::new(cav.clone())
                }),
            }
        }
    }

    /// Removes a neighbour that has left.
    pub fn forget(&mut self, cav: &CavId) {
        self.neighbours.remove(cav);
    }

    /// Seconds of the scene per second; `None` before the second own sweep.
    fn pace(&self) -> Option<f64> {
        let (first, last) = (self.own.front()?, self.own.back()?);
        let captured = last.capture_nanos.saturating_sub(first.capture_nanos);
        let arrived = last.arrived_nanos.saturating_sub(first.arrived_nanos);
        (arrived > 0).then(|| captured as f64 / arrived as f64)
    }

    /// True if the own agent paused between two sweeps: the pace does not explain their times. A shorter pause is outvoted
    /// by the sweeps before it.
    fn is_pause(&self, last: &SweepTime, next: &SweepTime) -> bool {
        let arrived = next.arrived_nanos.saturating_sub(last.arrived_nanos);
        let captured = next.capture_nanos as f64 - last.capture_nanos as f64;
        let pace = self.pace().filter(|_| arrived > WINDOW_NANOS / 2);
        let late = pace.map(|pace| (pace * arrived as f64 - captured) / pace.max(1.0));
        late.is_some_and(|nanos| nanos.abs() > LIMIT_NANOS as f64)
    }
}

impl NeighbourClock {
    fn add(&mut self, arrived_nanos: u64, ahead_nanos: i64) {
        self.samples.push_back((arrived_nanos, ahead_nanos));
        // Few sweeps of a slow scene are kept for longer.
        while let Some(&(at, _)) = self.samples.front()
            && (self.samples.len() > MAX_KEPT
                || self.samples.len() > 3 && at.saturating_add(WINDOW_NANOS) < arrived_nanos)
        {
            self.samples.pop_front();
        }
    }

    /// Estimates the offset; true if it has changed by more than sweeps may differ.
    fn judge(&mut self, cav: &CavId, pace: f64) -> bool {
        let mut sorted: Vec<i64> = self.samples.iter().map(|(_, ahead)| *ahead).collect();
        sorted.sort_unstable();
        let (Some(&least), Some(&most)) = (sorted.first(), sorted.last()) else {
            return false;
        };
        let [low, median, high] = [1, 2, 3].map(|quarter| sorted[quarter * sorted.len() / 4]);
        let [limit, unsteady] =
            [LIMIT_NANOS, UNSTEADY_NANOS].map(|nanos| (nanos as f64 * pace) as i64);
        // Arrivals are late on a busy machine, so that one sample that agrees is enough.
        let is_off = least > limit || most < -limit;
        let agrees =
            least.max(most.saturating_neg()) < limit / 2 && high.saturating_sub(low) <= limit;
        let before = self.offset_nanos;
        let wrong_by = distance(median, before);
        // A small change is believed only if the samples agree with each other.
        let is_certain = most.saturating_sub(least) <= limit || wrong_by > limit;
        self.offset_nanos = match before {
            _ if is_off && is_certain && wrong_by > limit / 5 => median,
            0 => 0,
            _ if agrees => 0,
            _ => before,
        };
        let is_unsteady =
            high.saturating_sub(low) > unsteady || distance(median, self.offset_nanos) > unsteady;
        if is_unsteady && !self.is_unsteady {
            let spread_s = most.saturating_sub(least) as f64 * 1e-9;
            tracing::warn!(%cav, spread_s, "capture clock of the vehicle is unsteady: its messages are left out");
        }
        self.is_unsteady = is_unsteady;
        let change = distance(self.offset_nanos, before);
        if before != 0 && self.offset_nanos == 0 {
            tracing::info!(%cav, "capture clock of the vehicle agrees with the ego's again");
        } else if change > limit {
            let ahead_s = self.offset_nanos as f64 * 1e-9;
            tracing::warn!(%cav, ahead_s, "capture clock of the vehicle differs from the ego's: its capture times are corrected");
        }
        change > limit / 2
    }
}

/// Capture time on the ego's clock of a sweep that arrived at `arrived_nanos`, between those of the ego's own sweeps;
/// `None` before the first.
fn own_capture(own: &VecDeque<SweepTime>, arrived_nanos: u64) -> Option<i128> {
    let next = own.partition_point(|sweep| sweep.arrived_nanos <= arrived_nanos);
    let before = own.get(next.checked_sub(1)?)?;
    let capture = i128::from(before.capture_nanos);
    let Some(after) = own.get(next) else {
        return Some(capture);
    };
    // `took` is not zero: `before` arrived by this time, `after` later.
    let [since, took] = [arrived_nanos, after.arrived_nanos]
        .map(|nanos| i128::from(nanos) - i128::from(before.arrived_nanos));
    let passed = i128::from(after.capture_nanos) - capture;
    Some(capture + passed * since / took)
}

fn distance(one: i64, other: i64) -> i64 {
    one.saturating_sub(other).saturating_abs()
}

#[cfg(test)]
mod tests {
    use super::*;

    const MS: u64 = 1_000_000;

    /// Offset of a neighbour, milliseconds, after each sweep of a scene with a period of 100 ms. `wall_ms` is the time
    /// between two sweeps; `ahead_ms` and `late_ms` give offset and delay of arrival of the neighbour's.
    fn offsets(
        wall_ms: u64,
        ahead_ms: impl Fn(u64) -> i64,
        late_ms: impl Fn(u64) -> u64,
    ) -> Vec<Option<i64>> {
        let mut clocks = CaptureClocks::new(false);
        let cav = CavId::new("9").unwrap();
        let began = 1_000_000_000_000 * MS;
        (0..60)
            .map(|tick| {
                let scene = 50_000 * MS + tick * 100 * MS;
                let arrived_nanos = began + tick * wall_ms * MS;
                clocks.note_own(SweepTime {
                    capture_nanos: scene,
                    arrived_nanos,
                });
                clocks.note(
                    &cav,
                    SweepTime {
                        capture_nanos: scene.saturating_add_signed(ahead_ms(tick) * MS as i64),
                        arrived_nanos: arrived_nanos + late_ms(tick) * MS,
                    },
                );
                clocks.update();
                let nanos = clocks.corrected(&cav, began)?;
                Some(((began as i64 - nanos as i64) as f64 / 1e6).round() as i64)
            })
            .collect()
    }

    #[test]
    fn a_constant_offset_is_found_after_three_sweeps() {
        for ahead in [100, 300, 3000, -300] {
            let found = offsets(100, |_| ahead, |tick| tick % 3);
            assert_eq!(found[1], Some(0));
            for offset in &found[4..] {
                assert!((offset.unwrap() - ahead).abs() <= 3, "{ahead}: {found:?}");
            }
        }
    }

    #[test]
    fn jitter_of_arrivals_is_no_offset_at_any_pace() {
        for wall_ms in [30, 100, 420, 5000] {
            let found = offsets(wall_ms, |_| 0, |tick| tick * 7 % 19);
            assert!(
                found.iter().all(|offset| *offset == Some(0)),
                "{wall_ms}: {found:?}"
            );
        }
    }

    #[test]
    fn an_offset_of_a_slow_scene_is_in_its_seconds() {
        let found = offsets(420, |_| 300, |_| 20);
        assert!((found[10].unwrap() - 295).abs() <= 2, "{found:?}");
    }

    #[test]
    fn a_step_is_followed_within_two_seconds_and_back() {
        let found = offsets(
            100,
            |tick| if (20..40).contains(&tick) { -1000 } else { 0 },
            |_| 2,
        );
        assert_eq!(found[19], Some(0));
        assert!((found[39].unwrap() + 1000).abs() <= 3, "{found:?}");
        assert!((found[38].unwrap() + 1000).abs() <= 3, "{found:?}");
        assert_eq!(found[59], Some(0), "{found:?}");
        assert!(found.contains(&None), "left out in between");
    }

    /// A sweep of a scene at 10 Hz that arrives `late_ms` after its moment.
    fn sweep(tick: u64, late_ms: u64) -> SweepTime {
        SweepTime {
            capture_nanos: (50_000 + tick * 100) * MS,
            arrived_nanos: (1_000_000_000_000 + tick * 100 + late_ms) * MS,
        }
    }

    #[test]
    fn sweeps_that_waited_while_the_own_agent_was_paused_are_no_offset() {
        let mut clocks = CaptureClocks::new(false);
        let cav = CavId::new("9").unwrap();
        for tick in 0..80 {
            clocks.note(&cav, sweep(tick, 0));
            match tick {
                20..60 => {}
                // The first two of the pause and the last two waited.
                60 => {
                    for (place, waited) in [20, 21, 58, 59, 60].into_iter().enumerate() {
                        clocks.note_own(sweep(waited, (60 - waited) * 100 + place as u64));
                    }
                }
                _ => clocks.note_own(sweep(tick, 0)),
            }
            assert!(clocks.update().is_empty(), "sweep {tick}");
            assert_eq!(clocks.corrected(&cav, 5), Some(5), "sweep {tick}");
        }
        assert_eq!(clocks.neighbours[&cav].samples.len(), 14, "dated again");
    }

    #[test]
    fn a_lap_of_the_scene_changes_no_offset() {
        let mut clocks = CaptureClocks::new(false);
        let cav = CavId::new("9").unwrap();
        for tick in 0..80 {
            let mut own = sweep(tick, 0);
            own.capture_nanos += tick / 40 * 61_000 * MS;
            clocks.note_own(own);
            clocks.note(
                &cav,
                SweepTime {
                    capture_nanos: own.capture_nanos + 200 * MS,
                    arrived_nanos: own.arrived_nanos - 5 * MS,
                },
            );
            clocks.update();
            if tick > 4 {
                assert_eq!(clocks.corrected(&cav, 1000 * MS), Some(795 * MS), "{tick}");
            }
        }
    }

    #[test]
    fn extreme_times_are_no_error() {
        let mut clocks = CaptureClocks::new(true);
        let cav = CavId::new("9").unwrap();
        let [capture_nanos, arrived_nanos] = [u64::MAX, 7];
        clocks.note_own(SweepTime {
            capture_nanos: 0,
            arrived_nanos,
        });
        clocks.note(
            &cav,
            SweepTime {
                capture_nanos,
                arrived_nanos,
            },
        );
        assert_eq!(clocks.update(), std::slice::from_ref(&cav));
        let mut states = Vec::new();
        clocks.describe(&mut states);
        assert!(states[0].capture_offset_s.unwrap() > 9e9);
        clocks.forget(&cav);
        assert_eq!(clocks.corrected(&cav, 5), Some(5));
    }
}
