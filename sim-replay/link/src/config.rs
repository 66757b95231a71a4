//! Configuration of a link.

use std::path::Path;

use protocol::config::{FieldError, within};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use support::file_error::FileError;

use super::device_clock::{ClockStep, DeviceClock};
use super::trace::Trace;
use super::trace_config::TraceConfig;

/// Payload of one fragment where loss is drawn per fragment, bytes: what fits an 802.11p frame with its headers.
pub(super) const FRAGMENT_BYTES: u64 = 1400;

/// Reasons why a link is invalid.
#[derive(Debug, thiserror::Error)]
pub enum LinkError {
    /// A value is out of bounds, or contradicts another.
    #[error("link: {0}")]
    Value(#[from] FieldError),
    /// A configuration or a trace cannot be read or used.
    #[error(transparent)]
    File(#[from] FileError),
}

/// Sharing of the medium.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum Medium {
    /// Every ordered pair of vehicles has its own link.
    #[default]
    PerPair,
    /// All messages share one queue and one rate, as on one radio channel.
    Shared,
}

/// Capacity of the link.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case", deny_unknown_fields)]
pub enum CapacityConfig {
    /// Unlimited.
    #[default]
    Unlimited,
    /// A token bucket.
    TokenBucket {
        /// Long-run rate, Mbit/s.
        bandwidth_mbps: f64,
        /// Bytes that may be sent at once, at the beginning and after a pause.
        #[serde(default)]
        burst_bytes: u64,
    },
    /// Rates over time from a CSV file: `time_s,bandwidth_mbps,latency_ms,loss`.
    Trace(TraceConfig),
    /// Delivery opportunities of 1,500 bytes each, in mahimahi's format: one line per packet, milliseconds; repeated.
    Mahimahi(TraceConfig),
}

impl CapacityConfig {
    /// A rate without bursts, Mbit/s; infinite: unlimited.
    pub fn of_mbps(bandwidth_mbps: f64) -> Self {
        match bandwidth_mbps == f64::INFINITY {
            true => Self::Unlimited,
            false => Self::TokenBucket {
                bandwidth_mbps,
                burst_bytes: 0,
            },
        }
    }

    /// The trace of the capacity.
    pub(super) fn trace(&self) -> Option<&TraceConfig> {
        match self {
            Self::Unlimited | Self::TokenBucket { .. } => None,
            Self::Trace(trace) | Self::Mahimahi(trace) => Some(trace),
        }
    }
}

/// Queue before the link.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct QueueConfig {
    /// Bytes that may wait, of urgent messages too, excluding the message that is being sent.
    pub bytes: u64,
    /// Message that is dropped if the queue is full.
    pub drop: QueueDrop,
    /// True if a newer message of the same stream replaces one that waits, which counts as `link_queue`.
    pub keep_last: bool,
    /// Messages of at most this many bytes do not wait behind larger ones, which they interrupt. They keep their own
    /// order.
    pub urgent_bytes: u64,
}

impl Default for QueueConfig {
    fn default() -> Self {
        Self {
            bytes: 16 << 20,
            drop: QueueDrop::Tail,
            keep_last: false,
            urgent_bytes: FRAGMENT_BYTES,
        }
    }
}

/// Message that is dropped if the queue is full.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum QueueDrop {
    /// The new message.
    #[default]
    Tail,
    /// The oldest messages in the queue.
    Head,
}

/// Model of the propagation delay, after the last bit was sent.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case", deny_unknown_fields)]
pub enum LatencyModel {
    /// None.
    #[default]
    None,
    /// Constant, milliseconds.
    ConstantMs(f64),
    /// Between two bounds, milliseconds.
    UniformMs([f64; 2]),
    /// Normal, with 0 in place of negative delays.
    Normal {
        /// Mean before that, milliseconds.
        mean_ms: f64,
        /// Standard deviation before that, milliseconds.
        std_ms: f64,
    },
    /// Lognormal.
    Lognormal {
        /// Median, milliseconds.
        median_ms: f64,
        /// Standard deviation of the logarithm.
        sigma: f64,
    },
    /// OpenCOOD's delay in its mode `real`, without any queue: uniform overhead, time by size, a fixed time.
    BySize {
        /// Largest overhead, milliseconds.
        overhead_ms: f64,
        /// Rate that the size is divided by, Mbit/s.
        bandwidth_mbps: f64,
        /// Fixed part, milliseconds.
        fixed_ms: f64,
    },
    /// The column of the capacity's trace.
    Trace,
}

/// Model of packet loss.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case", deny_unknown_fields)]
pub enum LossModel {
    /// No loss.
    #[default]
    None,
    /// Independent losses with one probability.
    Bernoulli(f64),
    /// A Markov chain of two states (Gilbert 1960, Elliott 1963) per sender and receiver, with one step per message or
    /// fragment of any stream: a burst counts poses too.
    GilbertElliott {
        /// Probability of going from good to bad.
        to_bad: f64,
        /// Probability of going from bad to good.
        to_good: f64,
        /// Loss in the good state.
        #[serde(default)]
        loss_good: f64,
        /// Loss in the bad state.
        #[serde(default = "one")]
        loss_bad: f64,
    },
    /// By the distance between sender and receiver: points of metres and probability, interpolated linearly. Beyond the
    /// last point, and without a position, that of the last.
    Distance(Vec<[f64; 2]>),
    /// The column of the capacity's trace.
    Trace,
}

fn one() -> f64 {
    1.0
}

/// Unit of loss.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum LossUnit {
    /// A message.
    #[default]
    Message,
    /// A fragment of 1,400 bytes; a message is lost with any of its fragments.
    Fragment,
}

/// Reordering: messages with an extra delay.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct ReorderConfig {
    /// Share of the messages.
    pub probability: f64,
    /// Extra delay, milliseconds.
    pub extra_ms: f64,
}

/// A time without any transmission, from the beginning of the scene, seconds. Messages whose transmission it cuts are lost; those that were sent before arrive.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Outage {
    /// First second.
    pub from_s: f64,
    /// Last second.
    pub to_s: f64,
}

/// A link, or all links of a shared medium.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct LinkConfig {
    /// Sharing of the medium.
    pub medium: Medium,
    /// Rate of the link.
    pub capacity: CapacityConfig,
    /// Queue before the link.
    pub queue: QueueConfig,
    /// Propagation delay of a message after its last bit was sent.
    pub latency: LatencyModel,
    /// The time from publication to arrival is rounded down to a multiple of this, milliseconds; 0 for none. OpenCOOD's
    /// evaluation has only whole frames of 100 ms.
    pub floor_ms: f64,
    /// True if jitter must not change the order of a sender's messages.
    pub keep_order: bool,
    /// Packet loss.
    pub loss: LossModel,
    /// Unit of loss: a message or a fragment.
    pub loss_unit: LossUnit,
    /// Reordering of messages.
    pub reorder: Option<ReorderConfig>,
    /// Share of the messages that arrive twice. No copy is used.
    pub duplicate: f64,
    /// Times without any transmission.
    pub outages: Vec<Outage>,
    /// The clock of every vehicle but the receiver, which sets the capture times of its messages.
    #[serde(skip_serializing_if = "DeviceClock::is_right")]
    pub clock: DeviceClock,
}

impl LinkConfig {
    /// Checks every number; files are not opened.
    ///
    /// # Errors
    /// [`FieldError`] with the first invalid field.
    pub fn validate(&self) -> Result<(), FieldError> {
        if let CapacityConfig::TokenBucket { bandwidth_mbps, .. } = self.capacity {
            within("capacity.bandwidth_mbps", bandwidth_mbps, 1e-6, 1e6)?;
        }
        within("clock.offset_ms", self.clock.offset_ms, -MAX_MS, MAX_MS)?;
        within("clock.drift_ppm", self.clock.drift_ppm, -1e5, 1e5)?;
        if let Some(ClockStep { at_s, by_ms }) = self.clock.step {
            within("clock.step.at_s", at_s, 0.0, 1e9)?;
            within("clock.step.by_ms", by_ms, -MAX_MS, MAX_MS)?;
        }
        match self.latency {
            LatencyModel::None | LatencyModel::Trace => {}
            LatencyModel::ConstantMs(ms) => time("latency", ms)?,
            LatencyModel::UniformMs([low, high]) => {
                time("latency", low)?;
                // The lower bound is the limit: a reversed pair is refused instead of being swapped.
                within("latency", high, low, MAX_MS)?;
            }
            LatencyModel::Normal { mean_ms, std_ms } => {
                time("latency.mean_ms", mean_ms)?;
                time("latency.std_ms", std_ms)?;
            }
            LatencyModel::BySize {
                overhead_ms,
                bandwidth_mbps,
                fixed_ms,
            } => {
                time("latency.overhead_ms", overhead_ms)?;
                within("latency.bandwidth_mbps", bandwidth_mbps, 1e-6, 1e6)?;
                time("latency.fixed_ms", fixed_ms)?;
            }
            LatencyModel::Lognormal { median_ms, sigma } => {
                time("latency.median_ms", median_ms)?;
                within("latency.sigma", sigma, 0.0, 5.0)?;
            }
        }
        time("floor_ms", self.floor_ms)?;
        match &self.loss {
            LossModel::None | LossModel::Trace => {}
            LossModel::Bernoulli(share) => probability("loss", *share)?,
            LossModel::GilbertElliott {
                to_bad,
                to_good,
                loss_good,
                loss_bad,
            } => {
                probability("loss.to_bad", *to_bad)?;
                probability("loss.to_good", *to_good)?;
                probability("loss.loss_good", *loss_good)?;
                probability("loss.loss_bad", *loss_bad)?;
            }
            LossModel::Distance(points) => {
                // The interpolation searches the points by bisection, so distances must not decrease.
                let mut last_m = 0.0;
                for &[distance_m, share] in points {
                    within("loss.distance", distance_m, last_m, 1e6)?;
                    probability("loss.distance", share)?;
                    last_m = distance_m;
                }
            }
        }
        if let Some(reorder) = self.reorder {
            probability("reorder.probability", reorder.probability)?;
            time("reorder.extra_ms", reorder.extra_ms)?;
        }
        probability("duplicate", self.duplicate)?;
        if let Some(trace) = self.capacity.trace() {
            within("offset_s", trace.offset_s, 0.0, 1e9)?;
        }
        for Outage { from_s, to_s } in &self.outages {
            within("outages.from_s", *from_s, 0.0, 1e9)?;
            within("outages.to_s", *to_s, *from_s, 1e9)?;
        }
        Ok(())
    }

    /// The file of the capacity's trace.
    pub fn trace_file(&self) -> Option<&Path> {
        self.capacity.trace().map(|trace| trace.path.as_path())
    }

    /// The capacity's trace; relative paths start at `folder`.
    ///
    /// # Errors
    /// [`LinkError`] if it is not readable, or lacks a column that the link needs.
    pub(super) fn read_trace(&self, folder: &Path) -> Result<Option<Trace>, LinkError> {
        let offset_nanos = self.capacity.trace().map_or(0, TraceConfig::offset_nanos);
        let trace = match &self.capacity {
            CapacityConfig::Unlimited | CapacityConfig::TokenBucket { .. } => None,
            CapacityConfig::Trace(TraceConfig { path, .. }) => {
                Some(Trace::read_csv(&folder.join(path), offset_nanos)?)
            }
            CapacityConfig::Mahimahi(TraceConfig { path, .. }) => {
                Some(Trace::read_mahimahi(&folder.join(path))?)
            }
        };
        // Delivery opportunities (mahimahi) state times only: neither delay nor loss can be read from them.
        let has_steps = matches!(trace, Some(Trace::Steps(_)));
        if self.latency == LatencyModel::Trace && !has_steps {
            return Err(FieldError::new("latency", "trace", NO_COLUMN).into());
        }
        if self.loss == LossModel::Trace && !has_steps {
            return Err(FieldError::new("loss", "trace", NO_COLUMN).into());
        }
        Ok(trace)
    }
}

/// Longest valid delay, milliseconds.
const MAX_MS: f64 = 600_000.0;

/// Rule of a delay or a loss from a trace.
const NO_COLUMN: &str = "capacity must name a trace with such a column";

fn time(field: &str, ms: f64) -> Result<(), FieldError> {
    within(field, ms, 0.0, MAX_MS)
}

fn probability(field: &str, share: f64) -> Result<(), FieldError> {
    within(field, share, 0.0, 1.0)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_file_names_every_stage() {
        let text = "medium: shared\ncapacity: {token_bucket: {bandwidth_mbps: 27, burst_bytes: 3000}}\n\
            queue: {bytes: 100000, drop: head, keep_last: true}\nlatency: {normal: {mean_ms: 10, std_ms: 3}}\n\
            loss: {gilbert_elliott: {to_bad: 0.01, to_good: 0.2}}\nloss_unit: fragment\n\
            reorder: {probability: 0.01, extra_ms: 30}\nduplicate: 0.001\noutages: [{from_s: 3, to_s: 13}]\n\
            clock: {offset_ms: -20, drift_ppm: 50, step: {at_s: 3, by_ms: 200}}\n";
        let config: LinkConfig = serde_saphyr::from_str(text).unwrap();
        config.validate().unwrap();
        assert_eq!(config.medium, Medium::Shared);
        assert_eq!(config.queue.urgent_bytes, FRAGMENT_BYTES);
        assert_eq!(
            config.loss,
            LossModel::GilbertElliott {
                to_bad: 0.01,
                to_good: 0.2,
                loss_good: 0.0,
                loss_bad: 1.0
            }
        );
        let written = serde_json::to_string(&config).unwrap();
        assert_eq!(
            serde_json::from_str::<LinkConfig>(&written).unwrap(),
            config
        );
        assert!(serde_saphyr::from_str::<LinkConfig>("dely: none\n").is_err());
    }

    #[test]
    fn wrong_numbers_are_named() {
        for (config, expected) in [
            (
                LinkConfig {
                    capacity: CapacityConfig::TokenBucket {
                        bandwidth_mbps: 0.0,
                        burst_bytes: 0,
                    },
                    ..LinkConfig::default()
                },
                "bandwidth_mbps is 0",
            ),
            (
                LinkConfig {
                    latency: LatencyModel::UniformMs([5.0, 2.0]),
                    ..LinkConfig::default()
                },
                "latency is 2",
            ),
            (
                LinkConfig {
                    clock: DeviceClock {
                        offset_ms: f64::NAN,
                        ..DeviceClock::default()
                    },
                    ..LinkConfig::default()
                },
                "offset_ms is NaN",
            ),
            (
                LinkConfig {
                    loss: LossModel::Bernoulli(f64::NAN),
                    ..LinkConfig::default()
                },
                "loss is NaN",
            ),
            (
                LinkConfig {
                    loss: LossModel::Distance(vec![[50.0, 0.1], [20.0, 0.2]]),
                    ..LinkConfig::default()
                },
                "loss.distance is 20: must be 50",
            ),
        ] {
            let message = config.validate().unwrap_err().to_string();
            assert!(message.contains(expected), "{message}");
        }
        let config = LinkConfig {
            latency: LatencyModel::Trace,
            ..LinkConfig::default()
        };
        let message = config.read_trace(Path::new(".")).unwrap_err().to_string();
        assert!(message.contains("latency is trace"), "{message}");
    }
}
