//! `ego-fuser train`: arguments, and a progress bar or plain lines.

use std::path::PathBuf;

use agent::model_config::DetectorConfig;
use agent::training::{AdamWConfig, DataListing, RunConfig, TrainingBar, TrainingOptions};
use anyhow::{Context, Result};
use ego_fuser::Method;
use ego_fuser::loss::{LossConfig, Unassigned};
use ego_fuser::samples::{Augmentation, PoseNoise, SampleConfig, SampleKind};
use ego_fuser::train::{self, Accuracy, Observer, StepReport, TrainConfig};

use super::BadInput;

/// Trains a method on scenes; writes checkpoint, curve.csv and curve.png, weights.safetensors and model-card.md.
#[derive(Debug, clap::Args)]
pub(crate) struct Arguments {
    /// Datasets, splits or scenarios to learn from.
    #[arg(long, required = true, num_args = 1.., value_name = "DIR")]
    data: Vec<PathBuf>,
    /// Datasets to measure AP on; none: no validation.
    #[arg(long, num_args = 1.., value_name = "DIR")]
    validation: Vec<PathBuf>,
    /// Method: none, early or one that exchanges feature maps; `ego-fuser methods` lists them.
    #[arg(long, default_value = "none")]
    method: Method,
    /// Network: lean or full; --init overrides it.
    #[arg(long, default_value = "lean", value_parser = parse_config)]
    config: DetectorConfig,
    /// Weights to begin with, for example those of `none`.
    #[arg(long, value_name = "FILE")]
    init: Option<PathBuf>,
    /// Samples of a step.
    #[arg(long, default_value_t = 4)]
    batch: usize,
    /// Highest learning rate.
    #[arg(long, default_value_t = 2e-3)]
    lr: f64,
    /// Weight decay.
    #[arg(long, default_value_t = 1e-2)]
    weight_decay: f64,
    /// Anchors between the overlap thresholds count for nothing, rather than as background as in OpenCOOD.
    #[arg(long)]
    ignore_unassigned: bool,
    /// Probability that a neighbour is missing from a sample.
    #[arg(long, default_value_t = 0.1)]
    drop_neighbour: f64,
    /// Standard deviation of the neighbours' positions in training, metres.
    #[arg(long, default_value_t = 0.0)]
    position_noise: f64,
    /// Standard deviation of the neighbours' headings in training, degrees.
    #[arg(long, default_value_t = 0.0)]
    heading_noise: f64,
    /// Largest turn of a vehicle's frame in training, degrees.
    #[arg(long, default_value_t = 45.0)]
    turn: f64,
    /// Vehicles of a sample at most.
    #[arg(long, default_value_t = 5)]
    max_agents: usize,
    /// Steps between two validations and checkpoints.
    #[arg(long, default_value_t = 500)]
    validate_every: u64,
    /// Frames of a validation.
    #[arg(long, default_value_t = 60)]
    validation_frames: usize,
    #[command(flatten)]
    options: TrainingOptions,
}

fn parse_config(name: &str) -> Result<DetectorConfig, String> {
    DetectorConfig::preset(name).ok_or_else(|| "there are lean and full".to_owned())
}

impl Arguments {
    /// Trains and says what came of it.
    pub(crate) fn run(&self) -> Result<()> {
        let config = self.config()?;
        let mut bar = Progress::default();
        let summary = train::run(&config, &mut bar)?;
        bar.0.finish();
        self.options.print(&summary.trained, &serde_json::json!({"accuracy": summary.accuracy}));
        Ok(())
    }

    fn config(&self) -> Result<TrainConfig> {
        if !(0.0..=1.0).contains(&self.drop_neighbour) || self.validate_every == 0 {
            let reason = "--drop-neighbour is a probability, --validate-every is above zero";
            return Err(BadInput(reason.into()).into());
        }
        for folder in self.data.iter().chain(&self.validation) {
            std::fs::read_dir(folder)
                .map_err(|error| BadInput(format!("{}: {error}", folder.display())))
                .context("datasets")?;
        }
        let samples = SampleConfig {
            augmentation: Augmentation { turn_rad: self.turn.to_radians(), ..Augmentation::default() },
            drop_neighbour: self.drop_neighbour,
            pose_noise: PoseNoise { position_m: self.position_noise, yaw_rad: self.heading_noise.to_radians() },
            max_agents: self.max_agents.max(1),
            ..SampleConfig::training(SampleKind::Single)
        };
        let unassigned = if self.ignore_unassigned { Unassigned::Ignored } else { Unassigned::Background };
        let run = self.options.run_config(self.batch, self.lr).map_err(|error| BadInput(error.to_string()))?;
        Ok(TrainConfig {
            data: self.data.clone(),
            validation: self.validation.clone(),
            method: self.method,
            detector: self.config.clone(),
            init: self.init.clone(),
            run: RunConfig { optimizer: AdamWConfig { weight_decay: self.weight_decay, ..run.optimizer }, ..run },
            validate_every: self.validate_every,
            validation_frames: self.validation_frames,
            samples,
            loss: LossConfig { unassigned, ..LossConfig::default() },
        })
    }
}

/// Shows on standard error how it goes.
#[derive(Default)]
struct Progress(TrainingBar);

impl Observer for Progress {
    fn opened(&mut self, data: &DataListing) {
        data.left_out().iter().for_each(|text| self.0.say(text));
    }

    fn stepped(&mut self, report: &StepReport) {
        let text = format!(
            "step {} epoch {:.2} loss {:.3} = {:.3} + {:.3} lr {:.1e} {:.1} samples/s, {:.0} % waiting",
            report.step,
            report.epoch,
            report.score_loss + report.box_loss,
            report.score_loss,
            report.box_loss,
            report.learning_rate,
            report.samples_per_second,
            100.0 * report.waiting
        );
        self.0.report(report.progress, report.seconds, &text);
    }

    fn validated(&mut self, step: u64, accuracy: &Accuracy) {
        let [ap_30, ap_50, ap_70] = accuracy.ap_global;
        self.0.say(&format!(
            "step {step}: AP@0.3/0.5/0.7 global {ap_30:.3} {ap_50:.3} {ap_70:.3} on {} frames",
            accuracy.frames
        ));
    }
}
