//! Clock offset of a sender, estimated from publish and arrival times.

use std::time::{Duration, Instant};

/// The fastest message of this period and of the period before it gives the estimate.
const WINDOW: Duration = Duration::from_secs(10);
/// Offset ahead beyond which a warning is logged, seconds.
const AHEAD_S: f64 = 0.05;
/// Longest transit time without a link emulation, seconds: the fastest message of a busy machine takes less.
pub const NETWORK_TRANSIT_S: f64 = 0.15;
/// Longest transit time behind a link emulation, seconds. A clock that is behind has the same effect, so that a warning
/// is logged beyond it.
const LINK_TRANSIT_S: f64 = 2.0;
/// A clock was set back if so many messages, over this period at least, are all slower than the estimate by more than the
/// longest transit time, nanoseconds.
const STEP_MESSAGES: u32 = 5;
const STEP_PERIOD: Duration = Duration::from_secs(1);
const STEP_NANOS: i64 = 150_000_000;

/// Longest transit time of a message, seconds.
pub fn longest_transit_s(over_link: bool) -> f64 {
    match over_link {
        true => LINK_TRANSIT_S,
        false => NETWORK_TRANSIT_S,
    }
}

/// True if the clock of a sender with this offset (its clock minus ours, seconds, minus the shortest transit time) counts
/// as ours: a transit time of up to `longest_transit_s` looks like a clock that is behind.
pub fn is_same_clock(offset_s: f64, longest_transit_s: f64) -> bool {
    (-longest_transit_s..=AHEAD_S).contains(&offset_s)
}

/// Clock offset of one sender.
#[derive(Debug, Clone, Copy)]
pub(super) struct ClockOffset {
    begun: Instant,
    /// Shortest difference of arrival and publish time, nanoseconds: in this period and in the previous one.
    shortest: [i64; 2],
    /// Successive messages that are slower than the estimate: arrival of the first, their number, and the shortest and the
    /// longest difference of arrival and publish time, nanoseconds.
    slow: Option<(Instant, u32, [i64; 2])>,
    was_far: bool,
}

impl ClockOffset {
    /// Estimate after the first message.
    pub(super) fn new(now: Instant) -> Self {
        Self {
            begun: now,
            shortest: [i64::MAX; 2],
            slow: None,
            was_far: false,
        }
    }

    /// Adds a message; returns whether the clock is far off if that has changed.
    pub(super) fn note(
        &mut self,
        sent_nanos: u64,
        arrived_nanos: u64,
        now: Instant,
    ) -> Option<bool> {
        // Two periods overlap: a new period does not begin with the estimate of a single message.
        if now.duration_since(self.begun) > WINDOW {
            self.begun = now;
            self.shortest = [i64::MAX, self.shortest[0]];
        }
        // In 128 bits: the time of a foreign clock may differ by more than an i64 holds.
        let took = i128::from(arrived_nanos) - i128::from(sent_nanos);
        let took = i64::try_from(took).unwrap_or(if took < 0 { i64::MIN } else { i64::MAX });
        if let Some(shortest) = self.since_step(took, now) {
            (self.begun, self.shortest) = (now, [shortest, i64::MAX]);
        }
        self.shortest[0] = self.shortest[0].min(took);
        let offset_s = self.seconds();
        // Hysteresis: an offset at the bound does not alternate between warning and notice.
        let half = if self.was_far { 0.5 } else { 1.0 };
        let is_far = offset_s > AHEAD_S * half || offset_s < -LINK_TRANSIT_S * half;
        let has_changed = is_far != self.was_far;
        self.was_far = is_far;
        has_changed.then_some(is_far)
    }

    /// The shortest difference since the sender's clock was set back, or ours forward, nanoseconds; `None`: no such step.
    fn since_step(&mut self, took: i64, now: Instant) -> Option<i64> {
        let (begun, messages, [least, most]) = self.slow.unwrap_or((now, 0, [took; 2]));
        let range = [least.min(took), most.max(took)];
        let slower = range[0].saturating_sub(self.shortest[0].min(self.shortest[1]));
        // A step delays all alike; transit times that are long differ by more.
        let is_steady = range[1].saturating_sub(range[0]) < slower / 2;
        let messages = messages.saturating_add(1);
        self.slow = (slower > STEP_NANOS && is_steady).then_some((begun, messages, range));
        let lasts = messages >= STEP_MESSAGES && now.duration_since(begun) >= STEP_PERIOD;
        (self.slow.is_some() && lasts).then_some(range[0])
    }

    /// The sender's clock minus ours, seconds, minus the shortest transit time.
    pub(super) fn seconds(&self) -> f64 {
        -(self.shortest[0].min(self.shortest[1]) as f64) * 1e-9
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_fastest_message_gives_the_offset_and_a_clock_step_is_detected() {
        let begun = Instant::now();
        let mut clock = ClockOffset::new(begun);
        for (at_s, ahead_ms, under_way_ms, expected) in [
            (0_u64, 0_i64, 30_i64, (None, -30)),
            (1, 0, 2, (None, -2)),
            (2, 500, 5, (Some(true), 495)),
            (3, 500, 5, (None, 495)),
            (14, 0, 5, (None, 495)),
            (30, 0, 5, (Some(false), -5)),
        ] {
            let now = 1_000_000_000_000_i64 + at_s as i64 * 1_000_000_000;
            let sent = now + (ahead_ms - under_way_ms) * 1_000_000;
            let change = clock.note(sent as u64, now as u64, begun + Duration::from_secs(at_s));
            let offset_ms = (clock.seconds() * 1e3).round() as i64;
            assert_eq!((change, offset_ms), expected, "at {at_s} s");
        }
    }

    #[test]
    fn a_clock_that_is_set_back_is_followed_after_a_second_and_slow_messages_are_no_step() {
        // Ten messages a second take 5 ms; these are the times of those after 2 s, milliseconds.
        let offset_ms = |messages: u64, took_ms: fn(u64) -> u64| {
            let begun = Instant::now();
            let mut clock = ClockOffset::new(begun);
            for message in 0..messages {
                let now = 1_000_000_000_000 + message * 100_000_000;
                let took_ms = if message < 20 { 5 } else { took_ms(message) };
                let at = begun + Duration::from_millis(message * 100);
                clock.note(now - took_ms * 1_000_000, now, at);
            }
            (clock.seconds() * 1e3).round() as i64
        };
        let set_back = |message: u64| 1005 + message % 3 * 40;
        assert_eq!(offset_ms(30, set_back), -5);
        assert_eq!(offset_ms(31, set_back), -1005);
        let back_again = |message: u64| if message < 31 { 1005 } else { 5 };
        assert_eq!(offset_ms(32, back_again), -5);
        let one_fast = |message: u64| if message == 30 { 5 } else { 1005 };
        assert_eq!(offset_ms(40, one_fast), -5);
        let busy = |message: u64| 200 + message % 2 * 100;
        assert_eq!(offset_ms(100, busy), -5);
    }
}
