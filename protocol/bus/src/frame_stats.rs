//! Frames from end to end: ticks, answers, fused neighbours, and latency from the capture to the detections.

use std::time::Duration;

use prometheus_client::metrics::histogram::Histogram;

/// Upper bounds of the latency histogram's buckets, seconds: finest where live runs are.
const LATENCY_BUCKETS_S: [f64; 16] = [
    0.02, 0.04, 0.06, 0.08, 0.1, 0.12, 0.15, 0.2, 0.25, 0.3, 0.4, 0.5, 0.75, 1.0, 2.0, 5.0,
];

/// Counters of frames since the process started.
#[derive(Debug, Clone, Default)]
pub struct FrameStats {
    /// Ticks of the scene, for a process that knows them.
    pub ticks: u64,
    /// Ticks with detections.
    pub answered: u64,
    /// Neighbours whose data were fused, over all frames.
    pub fused_neighbours: u64,
    /// Latencies from the publication of a tick to that of its detections, seconds; `None` before the first one.
    pub latency: Option<Histogram>,
}

impl FrameStats {
    /// Counts detections of one frame; `latency` is `None` in a process that does not know the time of its tick.
    pub(super) fn answer(&mut self, latency: Option<Duration>, fused_neighbours: usize) {
        self.answered += 1;
        self.fused_neighbours += fused_neighbours as u64;
        if let Some(latency) = latency {
            let known = self
                .latency
                .get_or_insert_with(|| Histogram::new(LATENCY_BUCKETS_S));
            known.observe(latency.as_secs_f64());
        }
    }
}
