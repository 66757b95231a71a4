//! Sweep reports: an agent's descriptor with the arrivals of its sweeps, for the capture clocks of egos.

use std::collections::VecDeque;

use perception::detector::Detector;
use protocol::message::{Descriptor, SweepArrival};
use protocol::{Dtype, Stream};

use super::LoopOptions;

/// Period at which an agent publishes its descriptor, for processes that join late and as a report of its sweeps,
/// nanoseconds.
const PERIOD_NANOS: u64 = 500_000_000;
/// First sweeps of a scene that are reported at once: so many make an estimate of the capture clock.
const EARLY_SWEEPS: usize = 3;
/// Sweeps of a report at most.
const MAX_SWEEPS: usize = 32;

/// Descriptor of an agent, and the sweeps of the next report.
#[derive(Debug)]
pub(super) struct SweepReports {
    /// None without a detector: no ego can use the vehicle's messages.
    description: Option<Descriptor>,
    /// Time of the next report, nanoseconds.
    pub(super) next_nanos: u64,
    /// Capture and arrival times of the sweeps since the last one, nanoseconds.
    sweeps: VecDeque<(u64, u64)>,
    /// Sweeps that are still reported at once.
    early: usize,
    /// True from the end of a scene to the first sweep of the next one: the reports name no stream.
    pub(super) has_ended: bool,
}

/// Descriptor of a vehicle that publishes these streams beside its pose, without sweeps.
pub fn descriptor(detector: &Detector, dtype: Dtype, publish: &[Stream]) -> Descriptor {
    Descriptor {
        model_hash: detector.model_hash(),
        grid: detector.grid(),
        channels: u32::try_from(detector.sent_shape()[0]).unwrap_or(u32::MAX),
        dtype,
        streams: (std::iter::once(Stream::Pose).chain(publish.iter().copied())).collect(),
        sweeps: Vec::new(),
    }
}

impl SweepReports {
    pub(super) fn new(detector: Option<&Detector>, options: &LoopOptions) -> Self {
        let (dtype, publish) = (options.codec.dtype, &options.publish);
        let description = detector.map(|detector| descriptor(detector, dtype, publish));
        Self {
            description,
            next_nanos: 0,
            sweeps: VecDeque::new(),
            early: EARLY_SWEEPS,
            has_ended: false,
        }
    }

    /// Adds a sweep to the next report, which is due at once if it is one of the first.
    pub(super) fn note(&mut self, capture_nanos: u64, arrived_nanos: u64) {
        let newest = self.sweeps.back();
        if newest.is_some_and(|(newest, _)| capture_nanos < *newest) {
            // The clock of the scene was set back.
            self.sweeps.clear();
        }
        if std::mem::take(&mut self.has_ended) {
            self.early = EARLY_SWEEPS;
        }
        self.sweeps.push_back((capture_nanos, arrived_nanos));
        if self.sweeps.len() > MAX_SWEEPS {
            self.sweeps.pop_front();
        }
        if self.early > 0 {
            self.early -= 1;
            self.next_nanos = 0;
        }
    }

    /// The report, if it is due, and the capture time of its newest sweep, nanoseconds.
    pub(super) fn take_due(&mut self, now_nanos: u64) -> Option<(u64, Descriptor)> {
        if now_nanos < self.next_nanos {
            return None;
        }
        // Without a description as well, or the loop would be woken again at once.
        self.next_nanos = now_nanos.saturating_add(PERIOD_NANOS);
        let newest = self.sweeps.back().map_or(0, |(capture, _)| *capture);
        let sweeps = self
            .sweeps
            .drain(..)
            .map(|(capture, arrived_nanos)| SweepArrival {
                before_nanos: newest.saturating_sub(capture),
                arrived_nanos,
            });
        let mut descriptor = self.description.clone()?;
        descriptor.sweeps = sweeps.collect();
        descriptor.streams.retain(|_| !self.has_ended);
        Some((newest, descriptor))
    }
}
