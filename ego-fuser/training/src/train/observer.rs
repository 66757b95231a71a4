//! Observer of a training: progress, validations and the result.

use perception::train::{DataListing, Trained};

use super::accuracy::Accuracy;

/// Report over some steps.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct StepReport {
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

/// Receives the progress of a training.
pub trait Observer {
    /// The data to learn from is known.
    fn opened(&mut self, data: &DataListing) {
        let _ = data;
    }
    /// Number of encoded sweeps and of all, for a frozen encoder.
    fn encoded(&mut self, done: usize, all: usize) {
        let _ = (done, all);
    }
    /// Some steps are done.
    fn stepped(&mut self, report: &StepReport);
    /// A validation is done.
    fn validated(&mut self, step: u64, accuracy: &Accuracy);
}

/// Result of a training.
#[derive(Debug, Clone)]
pub struct Summary {
    /// The weights and the cost of the training.
    pub trained: Trained,
    /// The last validation.
    pub accuracy: Option<Accuracy>,
}
