//! Durations and times as whole nanoseconds; values out of range become the nearest in range.

use std::time::{Duration, Instant};

use crate::rounding;

/// Nanoseconds of a duration.
pub fn of(time: Duration) -> u64 {
    u64::try_from(time.as_nanos()).unwrap_or(u64::MAX)
}

/// Nanoseconds from `began` to `at`; 0 if `at` is earlier.
pub fn between(began: Instant, at: Instant) -> u64 {
    of(at.saturating_duration_since(began))
}

/// Nanoseconds of milliseconds, rounded; 0 for negative values and for NaN.
pub fn of_ms(ms: f64) -> u64 {
    rounding::to_u64(ms * 1e6)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn times_out_of_range_become_the_nearest_in_range() {
        assert_eq!(
            (of(Duration::from_micros(3)), of(Duration::MAX)),
            (3_000, u64::MAX)
        );
        assert_eq!(
            [1.5, -1.0, f64::NAN, 1e300].map(of_ms),
            [1_500_000, 0, 0, u64::MAX]
        );
        let now = Instant::now();
        assert_eq!(
            (
                between(now, now + Duration::from_nanos(7)),
                between(now + Duration::from_nanos(7), now)
            ),
            (7, 0)
        );
    }
}
