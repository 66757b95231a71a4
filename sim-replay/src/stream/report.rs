//! Report of a replay.

use std::collections::BTreeMap;
use std::time::Duration;

use protocol::{DropReason, Ledger, TopicCount};
use serde::Serialize;

use dataset::frame::Frame;

use super::sensor_link::SensorLinkReport;
use support::statistics::{quantile, sorted};

/// Publishing later than this counts as late.
const LATE: Duration = Duration::from_millis(5);
/// Largest number of unreadable frames whose message is kept.
const KEPT: usize = 100;

/// Report of a replay.
#[derive(Debug, Clone, Default, Serialize)]
pub struct StreamReport {
    /// Ticks published.
    pub ticks: u64,
    /// Seconds from the first tick to the last.
    pub seconds: f64,
    /// Messages submitted, by topic.
    pub sent: Vec<TopicCount>,
    /// Of these, never sent, by reason: with a pace of its own a newer sweep replaces one that still waits for the
    /// network.
    pub unsent: BTreeMap<DropReason, u64>,
    /// Lateness of ticks; empty if the subscribers set the pace.
    pub lateness: Lateness,
    /// Ticks that an ego did not answer in time, under `--lockstep`.
    pub unanswered: u64,
    /// Frames that do not exist because their vehicle joined later or has left. Not a failure.
    pub absent_frames: u64,
    /// Objects and other parts of frames that were left out because they are invalid.
    pub left_out_parts: u64,
    /// Frames that could not be read.
    pub unreadable_frames: u64,
    /// The first of the unreadable frames.
    pub unreadable: Vec<Unreadable>,
    /// Counters of sensor frames on the emulated link, if there is one.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub sensor_link: Option<SensorLinkReport>,
}

/// A frame that could not be read.
#[derive(Debug, Clone, Serialize)]
pub struct Unreadable {
    /// Capture time of its tick, nanoseconds.
    pub capture_nanos: u64,
    /// File, field and fault.
    pub error: String,
}

/// Delay of the publication of ticks after their due time.
#[derive(Debug, Clone, Default, Serialize)]
pub struct Lateness {
    /// Ticks that were more than 5 ms late.
    pub late_ticks: u64,
    /// Median, milliseconds.
    pub p50_ms: f64,
    /// 95th percentile, milliseconds.
    pub p95_ms: f64,
    /// Largest, milliseconds.
    pub max_ms: f64,
    #[serde(skip)]
    samples: Vec<Duration>,
}

impl StreamReport {
    pub(super) fn unreadable(&mut self, capture_nanos: u64, error: &dyn std::error::Error) {
        tracing::error!(capture_nanos, "a frame is left out: {error}");
        self.unreadable_frames += 1;
        if self.unreadable.len() < KEPT {
            self.unreadable.push(Unreadable {
                capture_nanos,
                error: error.to_string(),
            });
        }
    }

    /// Adds the messages that this process dropped itself, from its message counters, and logs them.
    pub(super) fn count_unsent(&mut self, ledger: &Ledger) {
        let own = ledger.iter().filter(|(account, _)| account.to.is_none());
        for (reason, count) in own.flat_map(|(_, counts)| &counts.dropped) {
            *self.unsent.entry(*reason).or_default() += count;
        }
        if !self.unsent.is_empty() {
            tracing::warn!(unsent = ?self.unsent, "not everything was sent");
        }
    }

    pub(super) fn parts_left_out(&mut self, frame: &Frame) {
        for problem in &frame.problems {
            tracing::warn!(cav = %frame.cav, "left out: {}", problem.message);
        }
        self.left_out_parts += frame.problems.len() as u64;
    }

    /// True if every frame was read completely and every tick was answered as required. Replaced messages
    /// ([`Self::unsent`]) are no failure.
    pub fn is_complete(&self) -> bool {
        self.unreadable_frames == 0 && self.left_out_parts == 0 && self.unanswered == 0
    }
}

impl Lateness {
    /// Samples kept: one and a half hours at 10 Hz.
    const KEPT: usize = 1 << 16;

    pub(super) fn add(&mut self, late: Duration) {
        self.late_ticks += u64::from(late > LATE);
        // The maximum covers all ticks, the quantiles only the samples that are kept.
        self.max_ms = self.max_ms.max(late.as_secs_f64() * 1e3);
        if self.samples.len() < Self::KEPT {
            self.samples.push(late);
        }
    }

    pub(super) fn sum_up(&mut self) {
        let ms = self.samples.iter().map(|late| late.as_secs_f64() * 1e3);
        let ms = sorted(&ms.collect::<Vec<_>>());
        [self.p50_ms, self.p95_ms] = [0.5, 0.95].map(|q| quantile(&ms, q).unwrap_or(0.0));
    }
}

#[cfg(test)]
mod tests {
    use protocol::Account;

    use super::*;

    fn published(topic: &str) -> Account {
        Account::published(topic.parse().unwrap())
    }

    #[test]
    fn messages_dropped_before_sending_are_reported() {
        let mut ledger = Ledger::default();
        for topic in ["1/lidar", "2/lidar", "1/gnss"] {
            ledger.sent(&published(topic));
        }
        ledger.dropped(&published("1/lidar"), DropReason::Superseded);
        ledger.dropped(&published("2/lidar"), DropReason::Superseded);
        let subscribed =
            Account::towards("1/detections".parse().unwrap(), &"replay".parse().unwrap());
        ledger.dropped(&subscribed, DropReason::Superseded);
        let mut report = StreamReport::default();
        report.count_unsent(&ledger);
        assert_eq!(report.unsent, [(DropReason::Superseded, 2)].into());
        assert!(report.is_complete());
    }

    #[test]
    fn lateness_is_summed_up() {
        let mut lateness = Lateness::default();
        (1..=100).for_each(|ms| lateness.add(Duration::from_millis(ms)));
        lateness.sum_up();
        assert_eq!(
            (
                lateness.late_ticks,
                lateness.p50_ms,
                lateness.p95_ms,
                lateness.max_ms
            ),
            (95, 50.5, 95.05, 100.0)
        );
    }
}
