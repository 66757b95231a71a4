//! Pace of an ego: the sweeps that it has time for.

use serde::{Deserialize, Serialize};

use super::metadata_only;
use crate::{Limits, WireError};

/// Pace of an ego: one sweep per interval is computed by every vehicle, the same by all. Ego to agents.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct Pace {
    /// Interval of capture time, nanoseconds; 0: every sweep.
    pub interval_nanos: u64,
    /// A capture time at which an interval begins, nanoseconds.
    pub phase_nanos: u64,
}

/// Sweeps captured this long before an interval belong to it: sensors of different vehicles are not synchronised.
const TOLERANCE_NANOS: u64 = 25_000_000;

/// Longest interval of a message, nanoseconds: no ego may stop the agents of others.
const MAX_INTERVAL_NANOS: u64 = 10_000_000_000;

impl Pace {
    /// Every sweep.
    pub const EVERY_SWEEP: Self = Self {
        interval_nanos: 0,
        phase_nanos: 0,
    };

    /// Number of the interval of a capture time: the first sweep of each interval is computed. `None`: every sweep is.
    pub fn interval_of(&self, capture_nanos: u64) -> Option<i128> {
        let since =
            i128::from(capture_nanos) + i128::from(TOLERANCE_NANOS) - i128::from(self.phase_nanos);
        (self.interval_nanos > 0).then(|| since.div_euclid(i128::from(self.interval_nanos)))
    }

    fn check_values(&self, _: &Limits) -> Result<(), WireError> {
        let (max, found) = (MAX_INTERVAL_NANOS, self.interval_nanos);
        if found <= max {
            Ok(())
        } else {
            Err(WireError::Limit {
                what: "interval_nanos",
                max,
                found,
            })
        }
    }
}

metadata_only!(Pace, Pace);

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sweeps_of_one_time_are_in_one_interval_whatever_their_jitter() {
        let pace = Pace {
            interval_nanos: 200_000_000,
            phase_nanos: 500_000_000,
        };
        let interval = |ms: u64| pace.interval_of(ms * 1_000_000).unwrap();
        assert_eq!([interval(480), interval(500), interval(600)], [0, 0, 0]);
        assert_eq!([interval(680), interval(700), interval(860)], [1, 1, 1]);
        assert_eq!(interval(100), -2, "before the phase");
        assert_eq!(Pace::EVERY_SWEEP.interval_of(u64::MAX), None);
        assert!(
            Pace {
                interval_nanos: 1,
                phase_nanos: u64::MAX
            }
            .interval_of(0)
            .is_some()
        );
    }
}
