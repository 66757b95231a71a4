//! Observer of a training: progress, validations and the result.

use perception::train::{DataListing, Trained};
use serde::Serialize;

/// Report over some steps.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TrainingReport {
    /// Steps done.
    pub step: u64,
    /// Passes over the data.
    pub epoch: f64,
    /// Share of the training that is done, 0..1.
    pub progress: f64,
    /// Seconds spent so far, in all runs together.
    pub seconds: f64,
    /// Learning rate.
    pub learning_rate: f64,
    /// Classification term.
    pub score_loss: f64,
    /// Regression term.
    pub box_loss: f64,
    /// Samples per second since the last report.
    pub samples_per_second: f64,
    /// Share of that time spent waiting for samples, 0..1.
    pub waiting: f64,
}

/// AP over the frames of a validation.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Accuracy {
    /// Frames.
    pub frames: usize,
    /// AP at 0.3, 0.5 and 0.7, sorted over all frames; unknown without objects.
    pub ap_global: [Option<f64>; 3],
    /// The same in the order of frames.
    pub ap_frame_order: [Option<f64>; 3],
}

/// Receives the progress of a training.
pub trait TrainObserver {
    /// The data to learn from is known.
    fn opened(&mut self, _data: &DataListing) {}
    /// Number of encoded sweeps and of all, for a frozen encoder.
    fn encoded(&mut self, _done: usize, _all: usize) {}
    /// Some steps are done.
    fn stepped(&mut self, report: &TrainingReport);
    /// A validation is done.
    fn validated(&mut self, step: u64, accuracy: &Accuracy);
}

/// Result of a training.
#[derive(Debug, Clone)]
pub struct TrainSummary {
    /// The weights and the cost of the training.
    pub trained: Trained,
    /// The last validation.
    pub accuracy: Option<Accuracy>,
}
