//! Pace of an ego: the sweeps that it has time for.

use serde::{Deserialize, Serialize};

use super::{check_limit, check_within, metadata_only};
use crate::{Limits, WireError};

/// Pace of an ego: of every `of` sweeps, `computed` are computed, evenly spaced and the same ones in every vehicle. Ego
/// to agents.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct Pace {
    /// Sweep period, nanoseconds; 0: every sweep is computed.
    pub period_nanos: u64,
    /// Capture time of sweep 0, nanoseconds.
    pub phase_nanos: u64,
    /// Number of sweeps that are computed, 1..=`of`.
    pub computed: u8,
    /// Number of sweeps among which they are counted.
    pub of: u8,
}

/// Sweeps captured this long before their time count as in time, or half a period: sensors of different vehicles are
/// not synchronised.
const TOLERANCE_NANOS: u64 = 25_000_000;

/// Longest mean interval of a message, nanoseconds: no ego may stop the agents of others.
const MAX_INTERVAL_NANOS: u64 = 10_000_000_000;

impl Pace {
    /// Every sweep.
    pub const EVERY_SWEEP: Self = Self {
        period_nanos: 0,
        phase_nanos: 0,
        computed: 1,
        of: 1,
    };

    /// Number of the interval of a capture time: the first sweep of each interval is computed. `None`: every sweep is.
    ///
    /// Bresenham's line: sweep `n` is in interval `floor(n * computed / of)`, so that intervals differ in length by one
    /// sweep at most.
    pub fn interval_of(&self, capture_nanos: u64) -> Option<i128> {
        let [period, tolerance, capture, phase] = [
            self.period_nanos,
            TOLERANCE_NANOS.min(self.period_nanos / 2),
            capture_nanos,
            self.phase_nanos,
        ]
        .map(i128::from);
        // Euclidean: sweeps before the phase have negative numbers. A period of 0 gives `None`.
        let sweep = (capture + tolerance - phase).checked_div_euclid(period)?;
        (sweep * i128::from(self.computed)).checked_div_euclid(i128::from(self.of))
    }

    fn check_values(&self, _: &Limits) -> Result<(), WireError> {
        check_within("computed", self.computed.into(), 1.0, self.of.into())?;
        let sweeps_nanos = u128::from(self.period_nanos) * u128::from(self.of);
        let mean_nanos = sweeps_nanos / u128::from(self.computed);
        let found = u64::try_from(mean_nanos).unwrap_or(u64::MAX);
        check_limit("mean interval, nanoseconds", found, MAX_INTERVAL_NANOS)
    }
}

metadata_only!(Pace, Pace);

#[cfg(test)]
mod tests {
    use super::*;

    const PERIOD_NANOS: u64 = 100_000_000;

    fn pace(computed: u8, of: u8) -> Pace {
        Pace {
            period_nanos: PERIOD_NANOS,
            phase_nanos: 5 * PERIOD_NANOS,
            computed,
            of,
        }
    }

    /// Numbers of the computed sweeps of a vehicle whose captures are `late_nanos` late.
    fn computed(pace: &Pace, late_nanos: impl Fn(u64) -> i64) -> Vec<u64> {
        let intervals: Vec<Option<i128>> = (0..1001)
            .map(|sweep: u64| {
                let capture_nanos = (sweep * PERIOD_NANOS).saturating_add_signed(late_nanos(sweep));
                pace.interval_of(capture_nanos)
            })
            .collect();
        (1..)
            .zip(intervals.windows(2))
            .filter(|(_, pair)| pair[0] != pair[1])
            .map(|(sweep, _)| sweep)
            .collect()
    }

    #[test]
    fn every_ratio_is_exact_evenly_spaced_and_the_same_in_every_vehicle() {
        for of in 1..=20u8 {
            for share in 1..=of {
                let pace = pace(share, of);
                let sweeps = computed(&pace, |_| 0);
                for window in [20, 100, 1000].map(|tens| tens / usize::from(of) * usize::from(of)) {
                    let expected = window / usize::from(of) * usize::from(share);
                    let within = sweeps.iter().filter(|sweep| **sweep <= window as u64);
                    assert_eq!(within.count(), expected, "{pace:?} {window}");
                }
                let gaps: Vec<u64> = sweeps.windows(2).map(|pair| pair[1] - pair[0]).collect();
                let floor = u64::from(of / share);
                assert!(
                    gaps.iter().all(|gap| (floor..=floor + 1).contains(gap)),
                    "{pace:?} {gaps:?}"
                );
                let jittered = computed(&pace, |sweep| {
                    (sweep as i64 * 7_919_333) % 49_000_000 - 24_000_000
                });
                assert_eq!(jittered, sweeps, "{pace:?}");
                assert!(sweeps.contains(&5), "sweep 0 of the pace is computed");
            }
        }
    }

    #[test]
    fn every_sweep_has_no_interval_and_no_value_overflows() {
        assert_eq!(Pace::EVERY_SWEEP.interval_of(u64::MAX), None);
        let pace = Pace {
            period_nanos: 1,
            phase_nanos: u64::MAX,
            computed: u8::MAX,
            of: u8::MAX,
        };
        assert!(pace.interval_of(0).is_some_and(|interval| interval < 0));
        assert_eq!(Pace { of: 0, ..pace }.interval_of(0), None);
    }

    #[test]
    fn a_pace_of_no_sweep_and_one_beyond_the_longest_interval_are_refused() {
        for pace in [pace(1, 100), Pace::EVERY_SWEEP] {
            assert_eq!(pace.check_values(&Limits::DEFAULT), Ok(()));
        }
        for (pace, part) in [
            (pace(1, 101), "10100000000"),
            (pace(0, 1), "computed"),
            (pace(2, 1), "computed"),
            (pace(0, 0), "computed"),
        ] {
            let error = pace.check_values(&Limits::DEFAULT).unwrap_err();
            assert!(error.to_string().contains(part), "{error}");
        }
    }
}
