//! Frames from end to end: ticks, answers, fused neighbours, and latency from the capture to the detections.

use std::time::Duration;

/// Upper bounds of the latency histogram's buckets, seconds: finest where live runs are.
const LATENCY_BUCKETS_S: [f64; 16] = [
    0.02, 0.04, 0.06, 0.08, 0.1, 0.12, 0.15, 0.2, 0.25, 0.3, 0.4, 0.5, 0.75, 1.0, 2.0, 5.0,
];

/// Counters of frames since the process started.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct FrameStats {
    /// Ticks of the scene, for a process that knows them.
    pub ticks: u64,
    /// Ticks with detections.
    pub answered: u64,
    /// Neighbours whose data were fused, over all frames.
    pub fused_neighbours: u64,
    /// Sum of the latencies from the publication of a tick to that of its detections, seconds.
    pub latency_sum_s: f64,
    /// Number of these latencies.
    pub latencies: u64,
    buckets: [u64; LATENCY_BUCKETS_S.len() + 1],
}

impl FrameStats {
    /// Counts detections of one frame; `latency` is `None` in a process that does not know the time of its tick.
    pub(super) fn answer(&mut self, latency: Option<Duration>, fused_neighbours: usize) {
        self.answered += 1;
        self.fused_neighbours += fused_neighbours as u64;
        if let Some(latency_s) = latency.map(|latency| latency.as_secs_f64()) {
            self.latency_sum_s += latency_s;
            self.latencies += 1;
            let bucket = LATENCY_BUCKETS_S.partition_point(|end| *end < latency_s);
            if let Some(count) = self.buckets.get_mut(bucket) {
                *count += 1;
            }
        }
    }

    /// Upper bound in seconds and number of frames of every bucket of the latency; the last is unbounded
    /// ([`f64::MAX`]).
    pub fn latency_buckets(&self) -> Vec<(f64, u64)> {
        let ends = LATENCY_BUCKETS_S.into_iter().chain([f64::MAX]);
        ends.zip(self.buckets).collect()
    }
}
