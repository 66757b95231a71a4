//! Configuration and result of a training of a head.

use std::path::PathBuf;
use std::time::Duration;

use crate::training::{LeaveOut, SceneAccuracy, SweepAugmentation};
use perception::train::{RunConfig, Trained};

/// Configuration of a training of a head.
#[derive(Debug, Clone)]
pub struct SceneTrainConfig {
    /// Folders of sweeps, all of one scene.
    pub scenes: Vec<PathBuf>,
    /// Folders of sweeps of the same scene to validate on; none: no validation.
    pub validation: Vec<PathBuf>,
    /// Number of sweeps of a validation.
    pub validation_sweeps: usize,
    /// Weights of the encoder.
    pub encoder: PathBuf,
    /// Head of the same scene to start from; its sizes replace those below. `None`: random weights.
    pub init: Option<PathBuf>,
    /// Name of the scene; a head to start from keeps its own.
    pub scene_name: String,
    /// Clusters of sensor positions.
    pub classes: i64,
    /// Clusters of world coordinates.
    pub centres: i64,
    /// Channels of the head.
    pub width: i64,
    /// Residual blocks of the head.
    pub blocks: usize,
    /// True to train a refinement network.
    pub refiner: bool,
    /// Augmentation of sweeps before they are encoded.
    pub augmentation: SweepAugmentation,
    /// Selection of sweeps that may be left out; `None`: none.
    pub redundancy: Option<LeaveOut>,
    /// Training run; a batch are cells, a time counts from the start, reading and encoding included.
    pub run: RunConfig,
    /// Time between two validations and checkpoints.
    pub validate_every: Duration,
}

/// Result of a training of a head.
#[derive(Debug, Clone)]
pub struct SceneSummary {
    /// Weights, steps and time, reading and encoding included.
    pub trained: Trained,
    /// Seconds before the head's first step.
    pub preparing_seconds: f64,
    /// Name of the scene, as in the head.
    pub scene_name: String,
    /// Number of training sweeps.
    pub sweeps: usize,
    /// Number of cells in all batches.
    pub cells_shown: u64,
    /// Mean error of a training cell in the last steps, metres; `None` without a step.
    pub error_m: Option<f64>,
    /// The last validation.
    pub accuracy: Option<SceneAccuracy>,
}
