//! What a training of a head is told, and what it tells.

use std::path::PathBuf;
use std::time::Duration;

use crate::training::{RedundancyConfig, SceneAccuracy, SweepAugmentation};
use perception::train::{DataListing, RunConfig, Trained};

/// What to train, on what, for how long.
#[derive(Debug, Clone)]
pub struct SceneTrainConfig {
    /// Folders of scenes, all of one town.
    pub scenes: Vec<PathBuf>,
    /// Folders of scenes of the same town to validate on; none: no validation.
    pub validation: Vec<PathBuf>,
    /// Sweeps of a validation.
    pub validation_sweeps: usize,
    /// Weights of the encoder.
    pub encoder: PathBuf,
    /// Name of the town.
    pub town: String,
    /// Clusters of sensor positions.
    pub classes: i64,
    /// Clusters of world coordinates.
    pub centres: i64,
    /// Channels of the head.
    pub width: i64,
    /// Residual blocks of the head.
    pub blocks: usize,
    /// Whether there is a second look.
    pub refiner: bool,
    /// How sweeps are changed before they are encoded.
    pub augmentation: SweepAugmentation,
    /// Which sweeps may be left out; nothing: none.
    pub redundancy: Option<RedundancyConfig>,
    /// How; a batch are cells, a time counts from the start, reading and encoding included.
    pub run: RunConfig,
    /// Time between two validations and checkpoints.
    pub validate_every: Duration,
}

/// Where a training of a head is.
#[derive(Debug, Clone, PartialEq)]
pub enum SceneReport {
    /// Sweeps are being encoded: how many of how many are done.
    Encoding(usize, usize),
    /// All sweeps to learn from or to validate on are encoded.
    Encoded(DataListing),
    /// The classifier is done: share of training sweeps that it puts into their class.
    Classified(f64),
    /// Some steps are done.
    Stepped {
        /// Steps done.
        step: u64,
        /// Passes over the data.
        epoch: f64,
        /// Share that is done, 0..1.
        share_done: f64,
        /// Seconds since the start.
        seconds: f64,
        /// Mean L1 error of a cell since the last report, metres.
        error_m: f64,
        /// Mean predicted error, metres.
        epsilon_m: f64,
        /// Mean L1 error of the refiner's answers, metres.
        refined_m: f64,
    },
    /// A validation is done, after so many seconds.
    Validated(f64, SceneAccuracy),
}

/// How a training of a head ended.
#[derive(Debug, Clone)]
pub struct SceneSummary {
    /// The weights and what it took, reading and encoding included.
    pub trained: Trained,
    /// Seconds before the head's first step.
    pub preparing_seconds: f64,
    /// Sweeps it learnt from.
    pub sweeps: usize,
    /// Cells it was shown.
    pub cells_shown: u64,
    /// The last validation.
    pub accuracy: Option<SceneAccuracy>,
}
