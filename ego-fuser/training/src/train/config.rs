//! What a training is told.

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

/// What to train, on what, for how long.
#[derive(Debug, Clone)]
pub struct TrainConfig {
    /// Datasets to learn from.
    pub data: Vec<PathBuf>,
    /// Datasets to validate on; without any, AP is not measured.
    pub validation: Vec<PathBuf>,
    /// Which agents take part. Range and classes stand in `samples`.
    pub protocol: ProtocolConfig,
    /// What these datasets do not say of themselves.
    pub open: OpenOptions,
    /// The method.
    pub method: Method,
    /// The network, where `init` does not say.
    pub detector: DetectorConfig,
    /// Weights to begin with.
    pub init: Option<PathBuf>,
    /// The fusion, where it is not that of `init` or the usual one of the method.
    pub fusion: Option<FusionConfig>,
    /// Where the encoder of `init` stays as it is: where its maps are kept.
    pub frozen_encoder: Option<KeptMaps>,
    /// How; a batch are samples.
    pub run: RunConfig,
    /// Steps between two validations.
    pub validate_every: u64,
    /// Frames of a validation.
    pub validation_frames: usize,
    /// How samples are made.
    pub samples: SampleConfig,
    /// The loss.
    pub loss: LossConfig,
}
