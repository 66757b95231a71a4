//! Rate limits of an inbox: messages and bytes per second on each topic, and bytes waiting in total.
//!
//! A topic names its sender, and the router rejects other publishers of it, so a limit by topic is a limit by peer.

use std::collections::BTreeMap;
use std::sync::Mutex;
use std::time::Instant;

use protocol::Topic;
use support::sync::lock;

/// Maximum number of topics with a meter of their own; further topics share one meter.
const MAX_METERS: usize = 1024;
/// Burst after silence, seconds of the rate: messages held back by a network arrive together.
const BURST_S: f64 = 2.0;

/// Limits of an inbox.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct InboxLimits {
    /// Messages per second of one topic.
    pub messages_per_s: f64,
    /// Bytes per second of one topic.
    pub bytes_per_s: f64,
    /// Bytes that may wait, of all topics together.
    pub waiting_bytes: usize,
}

impl InboxLimits {
    /// No limits: for messages of one's own processes.
    pub const NONE: Self = Self {
        messages_per_s: f64::INFINITY,
        bytes_per_s: f64::INFINITY,
        waiting_bytes: usize::MAX,
    };
    /// Limits for messages of other vehicles: ten times the rate of a 10 Hz sender, with the largest feature maps.
    pub const PEERS: Self = Self {
        messages_per_s: 100.0,
        bytes_per_s: (256_u64 << 20) as f64,
        waiting_bytes: 512 << 20,
    };
}

/// Token buckets of an inbox, one for each topic.
pub(super) struct RateLimiter {
    limits: InboxLimits,
    meters: Mutex<BTreeMap<Option<Topic>, Meter>>,
}

/// Remaining budget of a topic at a time.
struct Meter {
    messages: f64,
    bytes: f64,
    at: Instant,
}

impl RateLimiter {
    pub(super) fn new(limits: InboxLimits) -> Self {
        let meters = Mutex::default();
        Self { limits, meters }
    }

    /// True if a message of `bytes` bytes keeps within the rates.
    pub(super) fn admit(&self, topic: &Topic, bytes: usize, now: Instant) -> bool {
        let InboxLimits {
            messages_per_s,
            bytes_per_s,
            ..
        } = self.limits;
        if messages_per_s.is_infinite() && bytes_per_s.is_infinite() {
            return true;
        }
        let mut meters = lock(&self.meters);
        let own = Some(topic.clone());
        // Topics beyond the limit share a meter: a flood of forged topics gets the rate of one sender.
        let has_own = meters.len() < MAX_METERS || meters.contains_key(&own);
        let key = if has_own { own } else { None };
        // A rate far below one message per second still admits one from time to time.
        let burst = (messages_per_s * BURST_S).max(1.0);
        let meter = meters.entry(key).or_insert_with(|| Meter {
            messages: burst,
            bytes: bytes_per_s * BURST_S,
            at: now,
        });
        let passed = now.saturating_duration_since(meter.at).as_secs_f64();
        meter.messages = (meter.messages + passed * messages_per_s).min(burst);
        meter.bytes = (meter.bytes + passed * bytes_per_s).min(bytes_per_s * BURST_S);
        meter.at = now;
        // One message may have more bytes than the remaining budget, or no large message could ever pass; those after
        // it wait.
        let fits = meter.messages >= 1.0 && meter.bytes > 0.0;
        if fits {
            meter.messages -= 1.0;
            meter.bytes -= bytes as f64;
        }
        fits
    }
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use super::*;

    fn meters(messages_per_s: f64, bytes_per_s: f64) -> RateLimiter {
        RateLimiter::new(InboxLimits {
            messages_per_s,
            bytes_per_s,
            waiting_bytes: usize::MAX,
        })
    }

    /// Number of `count` messages, arriving in equal steps, that are admitted.
    fn admitted(
        meters: &RateLimiter,
        topic: &str,
        count: u32,
        step: Duration,
        bytes: usize,
    ) -> usize {
        let (topic, began) = (topic.parse().unwrap(), Instant::now());
        (0..count)
            .filter(|index| meters.admit(&topic, bytes, began + step * *index))
            .count()
    }

    #[test]
    fn a_flood_is_limited_to_its_rate_and_others_are_not_affected() {
        let meters = meters(20.0, 1e9);
        let flood = admitted(&meters, "1/bev", 10_000, Duration::from_millis(1), 1 << 10);
        assert!(
            (230..=241).contains(&flood),
            "10 s of 20 Hz and the first 2 s' worth: {flood}"
        );
        assert_eq!(
            admitted(&meters, "2/bev", 100, Duration::from_millis(100), 1 << 10),
            100
        );
    }

    #[test]
    fn a_large_message_is_charged_to_the_following_ones() {
        let meters = meters(1e6, 1e6);
        assert_eq!(
            admitted(&meters, "1/bev", 10, Duration::from_nanos(1), 3_000_000),
            1
        );
        let paid = Instant::now() + Duration::from_secs(2);
        assert!(
            meters.admit(&"1/bev".parse().unwrap(), 1, paid),
            "after 2 s there is room again"
        );
    }

    #[test]
    fn a_low_rate_admits_a_message_from_time_to_time() {
        let admitted = admitted(&meters(0.25, 1e9), "1/bev", 9, Duration::from_secs(1), 1);
        assert_eq!(admitted, 3, "at the beginning and every 4 s");
    }

    #[test]
    fn forged_topics_share_a_meter() {
        let meters = meters(1.0, 1e9);
        let now = Instant::now();
        let admitted = (0..5_000)
            .filter(|id| meters.admit(&format!("{id}/bev").parse().unwrap(), 1, now))
            .count();
        assert_eq!(admitted, MAX_METERS + 2);
        assert!(meters.meters.lock().unwrap().len() <= MAX_METERS + 1);
    }
}
