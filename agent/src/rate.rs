//! Rate control of feature maps: fits their size to a configured rate or to the measured throughput of the agent's
//! queue.
//!
//! A feature map that has not left before the next one is submitted is superseded: a KEEP_LAST(1) queue stands before
//! every publisher. A smaller map that arrives is worth more than a full one that does not, so an agent can keep within
//! a size or a byte rate, or measure from the waiting times of its maps how much its queue lets through. The order of
//! reduction is defined in [`protocol::codec::encode_within`]: first a coarser number format, then the least confident
//! cells are left out.

use std::time::Duration;

use protocol::codec::{HEAD_BYTES, encode_within, largest_message, smallest_message};
use protocol::{
    BevFeatures, ByteLimit, CodecConfig, EncodedFeatures, LimitedBy, WireError, encode_features,
};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// Longest transmission time of a message at a byte rate, nanoseconds: the period of a LiDAR. With a longer one it
/// would arrive later than the map after it could have.
pub(crate) const LONGEST_TRANSMISSION_NANOS: u64 = 100_000_000;
/// Share of the time between two maps that one may wait for its turn before the queue counts as blocked.
const BLOCKED_SHARE: f64 = 0.25;
/// Share of the throughput of the blocked queue that is tried next: below one, so that the queue empties.
const BACK_OFF: f64 = 0.8;
/// Growth from map to map while the queue is free.
const GROWTH: f64 = 1.1;
/// Smallest share of the largest message that is tried, however blocked the queue is.
const SMALLEST_SHARE: f64 = 1.0 / 128.0;

/// Limits that feature maps are fitted to: first in a coarser number format, then with fewer cells, the most confident
/// ones.
#[derive(
    Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize, JsonSchema, clap::Args,
)]
#[serde(default, deny_unknown_fields)]
#[command(next_help_heading = "Rate control of feature maps")]
pub struct RateConfig {
    /// Largest message with a feature map, bytes, header and metadata included. Absent: any size.
    #[arg(long, value_name = "BYTES")]
    pub message_bytes: Option<u64>,
    /// Highest rate of such messages, bytes per second; each may take up to 100 ms of it. Absent: any.
    #[arg(long, value_name = "BYTES")]
    pub bytes_per_second: Option<u64>,
    /// Reduce the size while feature maps wait for earlier ones to leave, and increase it again when they do not.
    #[arg(long)]
    pub watch_queue: bool,
}

/// Turn of a message at the head of the sending queue.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct Turn {
    /// Number of messages submitted before it. Those between the last turn and this one were superseded.
    pub number: u64,
    /// Time of submission, nanoseconds.
    pub submitted_nanos: u64,
    /// Time at which the messages before it had left, nanoseconds.
    pub begun_nanos: u64,
}

/// Limits the size of each map, given the past ones.
#[derive(Debug, Clone, PartialEq, Default)]
pub(crate) struct RateControl {
    config: RateConfig,
    /// Capture time of the last map, nanoseconds.
    last_capture_nanos: Option<u64>,
    queue: QueueWatch,
}

impl RateControl {
    /// State before the first map.
    pub(crate) fn new(config: RateConfig) -> Self {
        Self {
            config,
            ..Self::default()
        }
    }

    /// Encodes a feature map as `codec` specifies, or smaller if a limit requires it; the message records format and
    /// reason. `turn` is known if there is a queue. Calls follow each other in the order of sending.
    pub(crate) fn encode(
        &mut self,
        features: BevFeatures,
        codec: &CodecConfig,
        confidence: &[f32],
        capture_nanos: u64,
        turn: Option<&Turn>,
    ) -> Result<EncodedFeatures, WireError> {
        let Some(limit) = self.limit(&features, codec, capture_nanos, turn)? else {
            return encode_features(features, codec, Some(confidence));
        };
        let encoded = encode_within(features, codec, &limit, Some(confidence))?;
        self.queue.last_bytes = HEAD_BYTES + encoded.body.len() as u64;
        Ok(encoded)
    }

    /// The tightest of all limits; none if there is no limit.
    fn limit(
        &mut self,
        features: &BevFeatures,
        codec: &CodecConfig,
        capture_nanos: u64,
        turn: Option<&Turn>,
    ) -> Result<Option<ByteLimit>, WireError> {
        let config = self.config;
        let size = config
            .message_bytes
            .map(|bytes| (bytes, LimitedBy::MessageSize));
        // The transmission time that belongs to a map; also where the clock of the scene jumps.
        let last = self.last_capture_nanos.replace(capture_nanos);
        // A repeated or earlier capture time counts as a full period.
        let since = last.and_then(|last| capture_nanos.checked_sub(last));
        let since = since.filter(|nanos| *nanos > 0);
        let on_air_nanos = since.unwrap_or(u64::MAX).min(LONGEST_TRANSMISSION_NANOS);
        let rate = config.bytes_per_second;
        let rate = rate.map(|rate| (bytes_within(rate, on_air_nanos), LimitedBy::ByteRate));
        let queue = match turn.filter(|_| config.watch_queue) {
            Some(turn) => {
                let smallest = smallest_message(features)?;
                let largest = largest_message(features, codec)?;
                Some((self.queue.allow(turn, smallest, largest), LimitedBy::Queue))
            }
            None => None,
        };
        // The tightest limit decides, and is named in the message.
        let tightest = ([size, rate, queue].into_iter().flatten()).min_by_key(|(bytes, _)| *bytes);
        Ok(tightest.map(|(bytes, by)| ByteLimit { bytes, by }))
    }
}

/// Number of bytes that `bytes_per_second` allows in some nanoseconds.
fn bytes_within(bytes_per_second: u64, nanos: u64) -> u64 {
    // In 128 bits, so that no configured rate overflows.
    let bytes = u128::from(bytes_per_second) * u128::from(nanos) / 1_000_000_000;
    u64::try_from(bytes).unwrap_or(u64::MAX)
}

/// Time between two times in nanoseconds; zero if the second is earlier.
fn between(from_nanos: u64, to_nanos: u64) -> Duration {
    Duration::from_nanos(to_nanos.saturating_sub(from_nanos))
}

/// Estimates the throughput of the agent's own queue.
///
/// While a map waits, the time from the last one's turn to its own is the time that the last one took to leave: the
/// throughput of that time, less a reserve, is tried next. While none waits, the size grows until maps are full again.
#[derive(Debug, Clone, PartialEq, Default)]
struct QueueWatch {
    last: Option<Turn>,
    /// Size of the last message, bytes.
    last_bytes: u64,
    /// Last limit, bytes; none while maps are full.
    allowed: Option<f64>,
}

impl QueueWatch {
    /// Largest size of the next message, bytes.
    fn allow(&mut self, turn: &Turn, smallest: u64, largest: u64) -> u64 {
        // Twice an empty message at least, so that there is room for cells.
        let floor = (largest as f64 * SMALLEST_SHARE).max(2.0 * smallest as f64);
        if let Some(last) = self.last.replace(*turn) {
            let submissions = turn.number.saturating_sub(last.number).max(1);
            let period = between(last.submitted_nanos, turn.submitted_nanos);
            // Superseded maps were submitted in between: the period is that of a single one.
            let period = period.div_f64(submissions as f64);
            let waited = between(turn.submitted_nanos, turn.begun_nanos);
            // A superseded map shows a blocked queue even if this one did not wait for long.
            self.allowed = if submissions > 1 || waited > period.mul_f64(BLOCKED_SHARE) {
                let took = between(last.begun_nanos, turn.begun_nanos);
                // At the throughput of the last message this share of it leaves in one period.
                let sent_share = period.as_secs_f64() / took.as_secs_f64().max(1e-6);
                let backed_off = BACK_OFF * self.last_bytes as f64 * sent_share.min(1.0);
                Some(backed_off.max(floor))
            } else {
                self.allowed.map(|bytes| bytes * GROWTH)
            };
        }
        self.allowed = self.allowed.filter(|bytes| *bytes < largest as f64);
        self.allowed.map_or(largest, |bytes| bytes as u64)
    }
}

#[cfg(test)]
mod tests {
    use protocol::{BevGrid, Dtype, RateReason, Selection};
    use support::nanos;

    use super::*;

    const GRID: BevGrid = BevGrid {
        x_min_m: -25.6,
        y_min_m: -19.2,
        cell_m: 0.8,
        width: 64,
        height: 48,
    };
    const CHANNELS: u32 = 16;
    /// Size of a map `[16, 48, 64]` as `f32`.
    const FULL_BYTES: u64 = 4 * 16 * 48 * 64;

    fn map() -> (BevFeatures, Vec<f32>) {
        let values = (0..CHANNELS as usize * GRID.cells())
            .map(|n| (n as f32 * 0.31).cos())
            .collect();
        let confidence = (0..GRID.cells())
            .map(|cell| (cell * 101 % 997) as f32 / 997.0)
            .collect();
        (
            BevFeatures {
                grid: GRID,
                channels: CHANNELS,
                code_of: None,
                values,
            },
            confidence,
        )
    }

    fn encode(
        control: &mut RateControl,
        capture_nanos: u64,
        turn: Option<&Turn>,
    ) -> EncodedFeatures {
        let (features, confidence) = map();
        control
            .encode(
                features,
                &CodecConfig::default(),
                &confidence,
                capture_nanos,
                turn,
            )
            .unwrap()
    }

    /// Maps at 10 Hz over a sender that takes `bytes_per_second(second)`; each sent one with its waiting time.
    struct SlowLink {
        control: RateControl,
        /// Time from the beginning until the sender is free.
        free: Duration,
        number: u64,
        waiting: Option<(u64, Duration)>,
    }

    impl SlowLink {
        fn new() -> Self {
            let control = RateControl::new(RateConfig {
                watch_queue: true,
                ..RateConfig::default()
            });
            Self {
                control,
                free: Duration::ZERO,
                number: 0,
                waiting: None,
            }
        }

        /// Runs `frames` more; sizes and waiting times of the maps that were sent, and the number that was superseded.
        fn drive(&mut self, frames: u64, bytes_per_second: f64) -> (Vec<(u64, Duration)>, u64) {
            let (mut sent, mut superseded) = (Vec::new(), 0);
            for _ in 0..frames {
                let submitted = Duration::from_millis(100 * self.number);
                if self.free <= submitted {
                    self.send(bytes_per_second, &mut sent);
                }
                superseded += u64::from(self.waiting.replace((self.number, submitted)).is_some());
                self.number += 1;
                if self.free <= submitted {
                    self.send(bytes_per_second, &mut sent);
                }
            }
            (sent, superseded)
        }

        fn send(&mut self, bytes_per_second: f64, sent: &mut Vec<(u64, Duration)>) {
            let Some((number, submitted)) = self.waiting.take() else {
                return;
            };
            let begun = self.free.max(submitted);
            let [submitted_nanos, begun_nanos] = [submitted, begun].map(nanos::of);
            let turn = Turn {
                number,
                submitted_nanos,
                begun_nanos,
            };
            let bytes = HEAD_BYTES
                + encode(&mut self.control, 100_000_000 * number, Some(&turn))
                    .body
                    .len() as u64;
            self.free = begun + Duration::from_secs_f64(bytes as f64 / bytes_per_second);
            sent.push((bytes, begun - submitted));
        }
    }

    #[test]
    fn without_a_limit_maps_are_written_as_they_are() {
        let encoded = encode(&mut RateControl::default(), 0, None);
        assert_eq!(
            (encoded.codec.selection, encoded.rate),
            (Selection::Dense, None)
        );
        let mut watching = RateControl::new(RateConfig {
            watch_queue: true,
            ..RateConfig::default()
        });
        assert_eq!(
            encode(&mut watching, 0, None).rate,
            None,
            "there is no queue to watch"
        );
    }

    #[test]
    fn a_byte_rate_is_shared_out_by_capture_time() {
        let config = RateConfig {
            bytes_per_second: Some(1_000_000),
            ..RateConfig::default()
        };
        let mut control = RateControl::new(config);
        let limits: Vec<u64> = [500, 550, 650, 5000, 100]
            .map(|ms: u64| {
                encode(&mut control, ms * 1_000_000, None)
                    .rate
                    .unwrap()
                    .limit_bytes
            })
            .into();
        // The first has a full period, a later one the time passed, none more than a period; a scene may restart.
        assert_eq!(limits, [100_000, 50_000, 100_000, 100_000, 100_000]);
    }

    fn choice(encoded: &EncodedFeatures) -> (Dtype, RateReason) {
        (encoded.codec.dtype, encoded.rate.unwrap().reason)
    }

    #[test]
    fn the_tightest_limit_holds() {
        let config = RateConfig {
            message_bytes: Some(60_000),
            bytes_per_second: Some(1_000_000),
            ..RateConfig::default()
        };
        let mut control = RateControl::new(config);
        assert_eq!(
            choice(&encode(&mut control, 0, None)),
            (Dtype::I8, RateReason::SizeCoarser)
        );
        let closer = encode(&mut control, 40_000_000, None);
        assert!(
            matches!(closer.codec.selection, Selection::TopK { .. }) && closer.body.len() <= 40_000
        );
        assert_eq!(choice(&closer), (Dtype::I8, RateReason::RateFewerCells));
    }

    #[test]
    fn a_slow_link_makes_maps_smaller_and_a_fast_one_full_again() {
        let mut link = SlowLink::new();
        let (sent, superseded) = link.drive(20, 20e6);
        assert!(
            superseded == 0
                && sent
                    .iter()
                    .all(|(bytes, _)| *bytes == FULL_BYTES + HEAD_BYTES),
            "{sent:?}"
        );

        // 200 kB a second: 20 kB a period, a tenth of a full map.
        let (sent, superseded) = link.drive(100, 200e3);
        // The last full map takes a second to leave, and none is lost after it.
        assert!((5..12).contains(&superseded), "{superseded}");
        let settled = &sent[20..];
        let mean = settled.iter().map(|(bytes, _)| *bytes).sum::<u64>() / settled.len() as u64;
        assert!((14_000..21_000).contains(&mean), "{mean}");
        assert!(
            settled
                .iter()
                .all(|(_, waited)| *waited < Duration::from_millis(80)),
            "{settled:?}"
        );

        let (sent, superseded) = link.drive(60, 20e6);
        assert_eq!(superseded, 0);
        assert_eq!(sent.last().unwrap().0, FULL_BYTES + HEAD_BYTES);
        // Not at once: the throughput is estimated step by step.
        assert!(sent[5].0 < FULL_BYTES / 2, "{sent:?}");
    }

    #[test]
    fn a_link_that_takes_nothing_is_still_tried() {
        let mut link = SlowLink::new();
        let (sent, _) = link.drive(600, 20e3);
        let smallest = sent.iter().map(|(bytes, _)| *bytes).min().unwrap();
        assert!(
            smallest > FULL_BYTES / 150 && smallest < FULL_BYTES / 50,
            "{smallest}"
        );
    }

    /// Sizes of the messages over a slow link.
    fn sent_bytes() -> Vec<u64> {
        let (sent, _) = SlowLink::new().drive(80, 300e3);
        sent.into_iter().map(|(bytes, _)| bytes).collect()
    }

    #[test]
    fn the_same_past_gives_the_same_choice() {
        assert_eq!(sent_bytes(), sent_bytes());
    }
}
