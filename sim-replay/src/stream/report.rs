//! How a replay went.

use std::time::Duration;

use protocol::TopicCount;
use serde::Serialize;

use super::sensor_air::AirReport;

/// Publishing later than this counts as late.
const LATE: Duration = Duration::from_millis(5);
/// Unreadable frames that are kept with their message.
const KEPT: usize = 100;

/// How a replay went.
#[derive(Debug, Clone, Default, Serialize)]
pub struct StreamReport {
    /// Ticks published.
    pub ticks: u64,
    /// Seconds from the first tick to the last.
    pub seconds: f64,
    /// Messages published, by topic.
    pub sent: Vec<TopicCount>,
    /// How late ticks were; empty where the fleet set the pace.
    pub lateness: Lateness,
    /// Ticks that an ego did not answer in time, under `--lockstep`.
    pub unanswered: u64,
    /// Frames that could not be read.
    pub unreadable_frames: u64,
    /// The first of them.
    pub unreadable: Vec<Unreadable>,
    /// What the emulated air did to sensor frames, where there was one.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub air: Option<AirReport>,
}

/// A frame that could not be read.
#[derive(Debug, Clone, Serialize)]
pub struct Unreadable {
    /// Capture time of its tick, nanoseconds.
    pub capture_nanos: u64,
    /// File, field and what is wrong.
    pub error: String,
}

/// How much later than due ticks were published.
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
            self.unreadable.push(Unreadable { capture_nanos, error: error.to_string() });
        }
    }

    /// Whether everything of the scene went out.
    #[must_use]
    pub fn is_complete(&self) -> bool {
        self.unreadable_frames == 0 && self.unanswered == 0
    }
}

impl Lateness {
    /// Samples kept: one and a half hours at 10 Hz.
    const KEPT: usize = 1 << 16;

    pub(super) fn add(&mut self, late: Duration) {
        if late > LATE {
            self.late_ticks += 1;
        }
        self.max_ms = self.max_ms.max(late.as_secs_f64() * 1e3);
        if self.samples.len() < Self::KEPT {
            self.samples.push(late);
        }
    }

    pub(super) fn sum_up(&mut self) {
        self.samples.sort_unstable();
        let quantile_ms = |quantile: f64| {
            let rank = (quantile * self.samples.len() as f64).ceil() as usize;
            self.samples.get(rank.saturating_sub(1)).map_or(0.0, |late| late.as_secs_f64() * 1e3)
        };
        (self.p50_ms, self.p95_ms) = (quantile_ms(0.5), quantile_ms(0.95));
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn lateness_is_summed_up() {
        let mut lateness = Lateness::default();
        (1..=100).for_each(|ms| lateness.add(Duration::from_millis(ms)));
        lateness.sum_up();
        assert_eq!((lateness.late_ticks, lateness.p50_ms, lateness.p95_ms, lateness.max_ms), (95, 50.0, 95.0, 100.0));
    }
}
