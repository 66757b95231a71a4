//! How far the clock of a sender is from ours, from when it says it sent and when it came.

use std::time::{Duration, Instant};

/// The fastest message of so long a time counts, and of the time before it.
const WINDOW: Duration = Duration::from_secs(10);
/// Clocks further ahead than this are worth a word, seconds.
const AHEAD_S: f64 = 0.05;
/// Clocks further behind than this: what is under way for long looks the same.
const BEHIND_S: f64 = 2.0;

/// The clock of one sender.
#[derive(Debug, Clone, Copy)]
pub(super) struct ClockOffset {
    begun: Instant,
    /// Shortest time from sending to arrival by the two clocks, nanoseconds: in this window and in the one before.
    shortest: [i64; 2],
    was_far: bool,
}

impl ClockOffset {
    /// After the first message.
    pub(super) fn new(now: Instant) -> Self {
        Self { begun: now, shortest: [i64::MAX; 2], was_far: false }
    }

    /// Takes note of a message; whether the clock is far off where that is news.
    pub(super) fn note(&mut self, sent_nanos: u64, arrived_nanos: u64, now: Instant) -> Option<bool> {
        if now.duration_since(self.begun) > WINDOW {
            self.begun = now;
            self.shortest = [i64::MAX, self.shortest[0]];
        }
        let took = i128::from(arrived_nanos) - i128::from(sent_nanos);
        self.shortest[0] = self.shortest[0].min(took.clamp(i64::MIN.into(), i64::MAX.into()) as i64);
        let offset_s = self.seconds();
        let half = if self.was_far { 0.5 } else { 1.0 };
        let is_far = offset_s > AHEAD_S * half || offset_s < -BEHIND_S * half;
        let is_news = is_far != self.was_far;
        self.was_far = is_far;
        is_news.then_some(is_far)
    }

    /// The sender's clock less ours, seconds, less the shortest time a message was under way.
    pub(super) fn seconds(&self) -> f64 {
        -(self.shortest[0].min(self.shortest[1]) as f64) * 1e-9
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_fastest_message_tells_and_a_step_of_the_clock_is_seen() {
        let begun = Instant::now();
        let mut clock = ClockOffset::new(begun);
        let mut hear = |at_s: u64, ahead_ms: i64, under_way_ms: i64| {
            let now = 1_000_000_000_000_i64 + at_s as i64 * 1_000_000_000;
            let sent = now + (ahead_ms - under_way_ms) * 1_000_000;
            let news = clock.note(sent as u64, now as u64, begun + Duration::from_secs(at_s));
            (news, (clock.seconds() * 1e3).round() as i64)
        };
        assert_eq!(hear(0, 0, 30), (None, -30));
        assert_eq!(hear(1, 0, 2), (None, -2));
        assert_eq!(hear(2, 500, 5), (Some(true), 495));
        assert_eq!(hear(3, 500, 5), (None, 495));
        assert_eq!(hear(14, 0, 5), (None, 495));
        assert_eq!(hear(30, 0, 5), (Some(false), -5));
    }
}
