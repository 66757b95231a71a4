//! What a training is told.

use std::path::PathBuf;
use std::time::Duration;

use agent::model_config::DetectorConfig;
use tch::Device;

use crate::loss::LossConfig;
use crate::method::Method;
use crate::model::ComputePrecision;
use crate::samples::SampleConfig;
use agent::training::AdamWConfig;

/// What to train, on what, for how long.
#[derive(Debug, Clone)]
pub struct TrainConfig {
    /// Datasets to learn from.
    pub data: Vec<PathBuf>,
    /// Datasets to validate on; without any, AP is not measured.
    pub validation: Vec<PathBuf>,
    /// The method.
    pub method: Method,
    /// The network, where `init` does not say.
    pub detector: DetectorConfig,
    /// Weights to begin with.
    pub init: Option<PathBuf>,
    /// How long.
    pub length: Length,
    /// Samples of a step.
    pub batch: usize,
    /// Highest learning rate.
    pub learning_rate: f64,
    /// Seed of parameters, order and augmentation.
    pub seed: u64,
    /// Where the network computes.
    pub device: Device,
    /// Threads that prepare samples.
    pub loader_threads: usize,
    /// In which numbers the convolutions compute.
    pub precision: ComputePrecision,
    /// Folder of checkpoint, curve, weights and model card.
    pub out: PathBuf,
    /// Whether to go on from the checkpoint in `out`.
    pub resume: bool,
    /// Steps between two validations.
    pub validate_every: u64,
    /// Frames of a validation.
    pub validation_frames: usize,
    /// How samples are made.
    pub samples: SampleConfig,
    /// The loss.
    pub loss: LossConfig,
    /// The optimizer.
    pub optimizer: AdamWConfig,
    /// The command as the user gave it, for the model card.
    pub command: String,
}

/// Length of a training.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Length {
    /// So many steps.
    Steps(u64),
    /// So many passes over the data.
    Epochs(f64),
    /// As many steps as fit into a time; the learning rate follows the clock. Not repeatable to the bit.
    Time(Duration),
}
