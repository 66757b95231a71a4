//! Cumulative service curve of a link in integer bit-nanoseconds; rounding does not accumulate.

use support::rounding;

use super::config::CapacityConfig;
use super::trace::{OPPORTUNITY_BYTES, Step, Trace};
use super::trace_config::TraceConfig;

/// Work of one byte: 8 bits, times the nanoseconds of a second, so that bits per second times nanoseconds are work.
const WORK_PER_BYTE: u128 = 8_000_000_000;

/// Cumulative service curve of a link.
#[derive(Debug, Clone, PartialEq)]
pub(super) enum ServiceCurve {
    /// Unlimited rate.
    Unlimited,
    /// Constant rate, bit/s.
    Constant(u64),
    /// A rate that changes, with the work that is done before each step.
    Steps(Vec<(Step, u128)>),
    /// Delivery opportunities, nanoseconds, repeated after the last one.
    Opportunities(Vec<u64>),
    /// Another curve, from an offset on.
    Later {
        all: Box<Self>,
        /// Offset into that curve, nanoseconds.
        offset_nanos: u64,
    },
}

/// Work of a number of bytes.
pub(super) fn work(bytes: u64) -> u128 {
    u128::from(bytes) * WORK_PER_BYTE
}

impl ServiceCurve {
    pub(super) fn new(config: &CapacityConfig, trace: Option<&Trace>) -> Self {
        match (config, trace) {
            (CapacityConfig::TokenBucket { bandwidth_mbps, .. }, _) => {
                Self::Constant(rounding::to_u64(bandwidth_mbps * 1e6))
            }
            (_, Some(Trace::Steps(steps))) => {
                let mut done = 0;
                let mut last: Option<&Step> = None;
                let steps = steps.iter().map(|step| {
                    done += last.replace(step).map_or(0, |last| {
                        u128::from(last.bits_per_s) * u128::from(step.from_nanos - last.from_nanos)
                    });
                    (*step, done)
                });
                Self::Steps(steps.collect())
            }
            (config, Some(Trace::Opportunities(times))) => {
                let offset_nanos = config.trace().map_or(0, TraceConfig::offset_nanos);
                let all = Self::Opportunities(times.clone());
                if offset_nanos == 0 {
                    return all;
                }
                // The trace repeats, so its part before the offset cannot be cut off as in a CSV trace.
                let all = Box::new(all);
                Self::Later { all, offset_nanos }
            }
            _ => Self::Unlimited,
        }
    }

    /// Work that could be done from time 0 to `nanos`.
    pub(super) fn done_by(&self, nanos: u64) -> u128 {
        match self {
            // Never asked: the queue sends everything at once on an unlimited link.
            Self::Unlimited => 0,
            Self::Constant(rate) => u128::from(*rate) * u128::from(nanos),
            Self::Steps(steps) => {
                let after = steps.partition_point(|(step, _)| step.from_nanos <= nanos);
                let Some((step, before)) = steps.get(after.saturating_sub(1)) else {
                    return 0;
                };
                before + u128::from(step.bits_per_s) * u128::from(nanos - step.from_nanos)
            }
            Self::Opportunities(times) => {
                let Some(period) = times.last() else { return 0 };
                let (rounds, rest) = (nanos / period, nanos % period);
                // An opportunity counts from its own time on, so equality is included.
                let passed = times.partition_point(|&time| time <= rest) as u128;
                (u128::from(rounds) * times.len() as u128 + passed) * work(OPPORTUNITY_BYTES)
            }
            Self::Later { all, offset_nanos } => {
                all.done_by(nanos.saturating_add(*offset_nanos)) - all.done_by(*offset_nanos)
            }
        }
    }

    /// Time at which `work` will have been done; `None` if the rate stays 0.
    pub(super) fn time_of(&self, wanted: u128) -> Option<u64> {
        match self {
            Self::Unlimited => Some(0),
            // Rounded up: before the last nanosecond has passed, the last bit is not sent.
            Self::Constant(rate) => u64::try_from(wanted.div_ceil(u128::from(*rate))).ok(),
            Self::Steps(steps) => {
                let after = steps.partition_point(|(_, before)| *before < wanted);
                let (step, before) = steps.get(after.saturating_sub(1))?;
                let left = wanted.saturating_sub(*before);
                if left == 0 {
                    return Some(step.from_nanos);
                }
                let rate = u128::from(step.bits_per_s);
                // A last step with rate 0 never finishes the work.
                let nanos = (rate > 0).then(|| left.div_ceil(rate))?;
                step.from_nanos.checked_add(u64::try_from(nanos).ok()?)
            }
            Self::Opportunities(times) => {
                // Index of the opportunity that completes the work. A partly used one serves the next packet.
                let count = wanted.div_ceil(work(OPPORTUNITY_BYTES)).max(1) - 1;
                let (rounds, place) = (count / times.len() as u128, count % times.len() as u128);
                let (period, time) = (times.last()?, times.get(usize::try_from(place).ok()?)?);
                let began = u64::try_from(rounds).ok()?.checked_mul(*period)?;
                began.checked_add(*time)
            }
            Self::Later { all, offset_nanos } => {
                let before = all.done_by(*offset_nanos);
                let nanos = all.time_of(wanted.checked_add(before)?)?;
                Some(nanos.saturating_sub(*offset_nanos))
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn steps(rates: &[u64]) -> ServiceCurve {
        let steps = rates.iter().enumerate().map(|(index, &bits_per_s)| Step {
            from_nanos: index as u64 * 700_000_000,
            bits_per_s,
            latency_ms: 0.0,
            loss: 0.0,
        });
        let trace = Trace::Steps(steps.collect());
        ServiceCurve::new(
            &CapacityConfig::Trace(TraceConfig::new("trace.csv".as_ref())),
            Some(&trace),
        )
    }

    proptest! {
        #[test]
        fn work_is_done_exactly_at_its_computed_time(
            rates in prop::collection::vec(0_u64..50_000_000, 1..6), bytes in 1_u64..10_000_000, constant in 1_u64..1_000_000_000,
            mut times in prop::collection::vec(0_u64..5_000, 1..30),
        ) {
            times.sort_unstable();
            times.push(5_001);
            let times = times.iter().map(|ms| ms * 1_000_000).collect();
            let opportunities = ServiceCurve::Opportunities(times);
            let (all, offset_nanos) = (Box::new(opportunities.clone()), 9 * constant);
            let later = ServiceCurve::Later { all, offset_nanos };
            for capacity in [steps(&rates), ServiceCurve::Constant(constant), opportunities, later] {
                let Some(nanos) = capacity.time_of(work(bytes)) else {
                    prop_assert_eq!(rates.last(), Some(&0));
                    continue;
                };
                prop_assert!(capacity.done_by(nanos) >= work(bytes), "{:?}", capacity);
                prop_assert!(nanos == 0 || capacity.done_by(nanos - 1) < work(bytes), "{:?}", capacity);
            }
        }
    }

    #[test]
    fn an_opportunity_is_repeated_after_the_last() {
        let capacity = ServiceCurve::Opportunities(vec![2, 2, 5]);
        let times: Vec<_> = (1..=7)
            .map(|packet| capacity.time_of(work(packet * 1500)).unwrap())
            .collect();
        assert_eq!(times, [2, 2, 5, 7, 7, 10, 12]);
    }
}
