//! Configuration of a training.

use std::path::PathBuf;

use dataset::OpenOptions;
use perception::model_config::DetectorConfig;
use perception::train::RunConfig;

use crate::feature_store::KeptMaps;
use crate::loss::LossConfig;
use crate::samples::SampleConfig;
use dataset::evaluation_protocol::ProtocolConfig;
use fusion::FusionConfig;
use fusion::method::Method;

/// Method, data and duration of a training.
#[derive(Debug, Clone)]
pub struct TrainConfig {
    /// Datasets to learn from.
    pub data: Vec<PathBuf>,
    /// Datasets to validate on; without any, AP is not measured.
    pub validation: Vec<PathBuf>,
    /// Protocol that selects agents. Range and classes are in `samples`.
    pub protocol: ProtocolConfig,
    /// Options for properties that these datasets do not store.
    pub open: OpenOptions,
    /// The method.
    pub method: Method,
    /// The network, unless `init` determines it.
    pub detector: DetectorConfig,
    /// Weights to begin with.
    pub init: Option<PathBuf>,
    /// The fusion, if it is not that of `init` or the usual one of the method.
    pub fusion: Option<FusionConfig>,
    /// Store of the encoder's maps if the encoder of `init` is frozen; absent: it is trained.
    pub frozen_encoder: Option<KeptMaps>,
    /// True to freeze all of `init` and train its box input, which is made if it has none.
    pub box_input: bool,
    /// Training loop; a batch are samples.
    pub run: RunConfig,
    /// Steps between two validations.
    pub validate_every: u64,
    /// Frames of a validation.
    pub validation_frames: usize,
    /// Configuration of samples.
    pub samples: SampleConfig,
    /// The loss.
    pub loss: LossConfig,
}
