//! Short trainings for tests.

use std::path::Path;

use ::training::loss::LossConfig;
use ::training::samples::{SampleConfig, SampleKind};
use ::training::train::TrainConfig;
use dataset::OpenOptions;
use dataset::evaluation_protocol::ProtocolConfig;
use fusion::Method;
use perception::model_config::DetectorConfig;
use perception::train::{Length, RunConfig, TrainingEvent};

/// Observer of a training.
#[derive(Default)]
pub struct EventLog {
    /// Loss of each reported step.
    pub losses: Vec<f64>,
    /// Results of the validations in words.
    pub validations: Vec<String>,
    /// Number of encoded sweeps.
    pub encoded: usize,
}

impl EventLog {
    /// Takes an event in.
    pub fn add(&mut self, event: &TrainingEvent) {
        match event {
            TrainingEvent::Encoding(..) => self.encoded += 1,
            TrainingEvent::Stepped(report) => self.losses.push(report.means[0]),
            TrainingEvent::Validated(text) => self.validations.push(text.clone()),
            TrainingEvent::Read(_) | TrainingEvent::Note(_) => {}
        }
    }
}

/// A small network, feature maps of 16 channels on 44 x 64 cells: a BEV grid that no window of a transformer divides.
pub fn small() -> DetectorConfig {
    DetectorConfig {
        pillar_channels: 8,
        layer_nums: vec![1, 1],
        layer_strides: vec![2, 2],
        num_filters: vec![8, 16],
        upsample_strides: vec![1, 2],
        num_upsample_filters: vec![8; 2],
        shrink: None,
        lidar_range_m: [-25.6, -17.6, -3.0, 25.6, 17.6, 1.0],
        ..DetectorConfig::lean()
    }
}

/// Some steps of a method, from random weights and without validation.
pub fn config(data: &Path, out: &Path, method: Method, steps: u64) -> TrainConfig {
    TrainConfig {
        data: vec![data.to_owned()],
        validation: vec![],
        open: OpenOptions::default(),
        method,
        detector: small(),
        init: None,
        fusion: None,
        frozen_encoder: None,
        box_input: false,
        run: RunConfig {
            learning_rate: 2e-3,
            seed: 3,
            command: "a test".to_owned(),
            ..RunConfig::new(Length::Steps(steps), out)
        },
        validate_every: 1_000,
        validation_frames: 1,
        protocol: ProtocolConfig::default(),
        samples: SampleConfig::training(SampleKind::Single),
        loss: LossConfig::default(),
    }
}
