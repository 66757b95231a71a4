//! How far a training is.

use serde::{Deserialize, Serialize};

/// What a checkpoint remembers beside parameters and moments.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Progress {
    /// Steps done.
    pub step: u64,
    /// Seconds spent so far.
    pub seconds: f64,
    /// Seed of the training.
    pub seed: u64,
    /// Samples of a batch.
    pub batch: usize,
    /// Name of the method.
    pub method: String,
}
