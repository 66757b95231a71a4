//! Propagation delay.

use super::config::LatencyModel;
use super::trace::Step;
use support::nanos;
use support::random::SplitMix64;

impl LatencyModel {
    /// True if it contains the transmission at a rate, beside that of the capacity.
    pub fn has_rate(&self) -> bool {
        matches!(self, Self::BySize { .. })
    }

    /// Delay of one message, nanoseconds; `step` is that of the trace at which its last bit was sent.
    pub(super) fn draw(self, random: &mut SplitMix64, step: Option<&Step>, bytes: u64) -> u64 {
        // Negative draws of the normal distribution become 0 in the conversion.
        nanos::of_ms(match self {
            Self::None => 0.0,
            Self::ConstantMs(ms) => ms,
            Self::UniformMs([low, high]) => random.between(low, high),
            Self::Normal { mean_ms, std_ms } => mean_ms + std_ms * random.normal(),
            Self::Lognormal { median_ms, sigma } => median_ms * (sigma * random.normal()).exp(),
            Self::BySize {
                overhead_ms,
                bandwidth_mbps,
                fixed_ms,
            } => {
                let bits = 8.0 * bytes as f64;
                // 1 Mbit/s is 1000 bits per millisecond.
                random.between(0.0, overhead_ms) + bits / (1e3 * bandwidth_mbps) + fixed_ms
            }
            Self::Trace => step.map_or(0.0, |step| step.latency_ms),
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const COUNT: u64 = 20_000;

    fn draws(law: LatencyModel) -> Vec<f64> {
        (0..COUNT)
            .map(|k| law.draw(&mut SplitMix64::derived(3, &[k]), None, 132_500) as f64 * 1e-6)
            .collect()
    }

    fn check(law: LatencyModel, mean: f64, std: f64) {
        let draws = draws(law);
        let found = draws.iter().sum::<f64>() / COUNT as f64;
        let deviation = 3.0 * std / (COUNT as f64).sqrt();
        assert!(
            (found - mean).abs() <= deviation + 1e-6,
            "{law:?}: {found}, not {mean} +- {deviation}"
        );
    }

    #[test]
    fn every_law_has_its_mean() {
        check(LatencyModel::None, 0.0, 0.0);
        check(LatencyModel::ConstantMs(12.5), 12.5, 0.0);
        check(
            LatencyModel::UniformMs([20.0, 100.0]),
            60.0,
            80.0 / 12f64.sqrt(),
        );
        // 1.06 Mbit at 27 Mbit/s take 39.26 ms.
        let by_size = LatencyModel::BySize {
            overhead_ms: 100.0,
            bandwidth_mbps: 27.0,
            fixed_ms: 10.0,
        };
        check(by_size, 50.0 + 39.259_259 + 10.0, 100.0 / 12f64.sqrt());
        // Nine standard deviations from 0: no truncation.
        check(
            LatencyModel::Normal {
                mean_ms: 45.0,
                std_ms: 5.0,
            },
            45.0,
            5.0,
        );
        let (median, sigma) = (10.0, 0.5f64);
        let mean = median * (0.5 * sigma * sigma).exp();
        check(
            LatencyModel::Lognormal {
                median_ms: median,
                sigma,
            },
            mean,
            mean * ((sigma * sigma).exp() - 1.0).sqrt(),
        );
    }

    #[test]
    fn no_delay_is_below_zero() {
        assert!(
            draws(LatencyModel::Normal {
                mean_ms: 1.0,
                std_ms: 10.0
            })
            .iter()
            .all(|&ms| ms >= 0.0)
        );
    }
}
