//! `ego-fuser train`: arguments, and a progress bar or plain lines.

use std::io::IsTerminal;
use std::path::PathBuf;
use std::time::{Duration, Instant};

use agent::model_config::DetectorConfig;
use agent::training::AdamWConfig;
use anyhow::{Context, Result};
use clap::ValueEnum;
use ego_fuser::Method;
use ego_fuser::loss::{LossConfig, Unassigned};
use ego_fuser::model::ComputePrecision;
use ego_fuser::samples::{Augmentation, PoseNoise, SampleConfig, SampleKind};
use ego_fuser::train::{self, Accuracy, Length, Observer, StepReport, TrainConfig};
use indicatif::{ProgressBar, ProgressStyle};
use tch::{Cuda, Device};

use super::BadInput;

/// Plain lines come no more often than this.
const LINE_EVERY: Duration = Duration::from_secs(10);
/// Resolution of the progress bar.
const BAR_TICKS: u64 = 10_000;

/// Trains a method on scenes; writes checkpoint, curve.csv and curve.png, weights.safetensors and model-card.md.
#[derive(Debug, clap::Args)]
pub(crate) struct Arguments {
    /// Datasets, splits or scenarios to learn from.
    #[arg(long, required = true, num_args = 1.., value_name = "DIR")]
    data: Vec<PathBuf>,
    /// Datasets to measure AP on; none: no validation.
    #[arg(long, num_args = 1.., value_name = "DIR")]
    validation: Vec<PathBuf>,
    /// Method: none, early, max or attention.
    #[arg(long, default_value = "none")]
    method: Method,
    /// Network: lean or full; --init overrides it.
    #[arg(long, default_value = "lean", value_parser = parse_config)]
    config: DetectorConfig,
    /// Weights to begin with, for example those of `none`.
    #[arg(long, value_name = "FILE")]
    init: Option<PathBuf>,
    /// Length in steps.
    #[arg(long, group = "length")]
    steps: Option<u64>,
    /// Length in passes over the data.
    #[arg(long, group = "length")]
    epochs: Option<f64>,
    /// Length in minutes; the learning rate follows the clock, so the result is not repeatable to the bit.
    #[arg(long, group = "length")]
    minutes: Option<f64>,
    /// Samples of a step.
    #[arg(long, default_value_t = 4)]
    batch: usize,
    /// Highest learning rate.
    #[arg(long, default_value_t = 2e-3)]
    lr: f64,
    /// Weight decay.
    #[arg(long, default_value_t = 1e-2)]
    weight_decay: f64,
    /// Seed of parameters, order and augmentation.
    #[arg(long, default_value_t = 0)]
    seed: u64,
    /// Where to compute: cpu or cuda.
    #[arg(long, default_value = "cpu")]
    device: DeviceName,
    /// Threads of the network on the CPU.
    #[arg(long, default_value_t = 1)]
    threads: u16,
    /// Threads that prepare samples.
    #[arg(long, default_value_t = 1)]
    loader_threads: usize,
    /// Numbers that convolutions compute in: f32 or bf16.
    #[arg(long, default_value = "f32")]
    precision: PrecisionName,
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
    /// Folder of the results.
    #[arg(long, value_name = "DIR")]
    out: PathBuf,
    /// Go on from the checkpoint in --out.
    #[arg(long)]
    resume: bool,
    /// Print the summary as JSON.
    #[arg(long)]
    json: bool,
}

#[derive(Debug, Clone, Copy, ValueEnum)]
enum DeviceName {
    Cpu,
    Cuda,
}

#[derive(Debug, Clone, Copy, ValueEnum)]
enum PrecisionName {
    F32,
    Bf16,
}

fn parse_config(name: &str) -> Result<DetectorConfig, String> {
    DetectorConfig::preset(name).ok_or_else(|| "there are lean and full".to_owned())
}

impl Arguments {
    /// Trains and says what came of it.
    pub(crate) fn run(self) -> Result<()> {
        let json = self.json;
        tch::set_num_threads(i32::from(self.threads.max(1)));
        let config = self.config()?;
        let mut progress = Progress::new();
        let summary = train::run(&config, &mut progress)?;
        progress.bar.finish_and_clear();
        if json {
            let accuracy = serde_json::to_value(summary.accuracy)?;
            println!(
                "{}",
                serde_json::json!({"steps": summary.steps, "seconds": summary.seconds, "accuracy": accuracy,
                    "weights": summary.weights, "sha256": summary.sha256})
            );
        } else {
            println!("{} steps in {:.0} s: {}", summary.steps, summary.seconds, summary.weights.display());
        }
        Ok(())
    }

    fn config(self) -> Result<TrainConfig> {
        let length = match (self.steps, self.epochs, self.minutes) {
            (Some(steps), _, _) => Length::Steps(steps),
            (_, Some(epochs), _) if epochs > 0.0 => Length::Epochs(epochs),
            (_, _, Some(minutes)) if minutes > 0.0 => Length::Time(Duration::from_secs_f64(60.0 * minutes)),
            _ => return Err(BadInput("one of --steps, --epochs and --minutes is needed, above zero".into()).into()),
        };
        if !(0.0..=1.0).contains(&self.drop_neighbour) || self.batch == 0 || self.validate_every == 0 {
            let reason = "--drop-neighbour is a probability, --batch and --validate-every are above zero";
            return Err(BadInput(reason.into()).into());
        }
        let device = match self.device {
            DeviceName::Cpu => Device::Cpu,
            DeviceName::Cuda if Cuda::is_available() => Device::Cuda(0),
            DeviceName::Cuda => return Err(BadInput("no CUDA device, or a libtorch without CUDA".into()).into()),
        };
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
        Ok(TrainConfig {
            data: self.data,
            validation: self.validation,
            method: self.method,
            detector: self.config,
            init: self.init,
            length,
            batch: self.batch,
            learning_rate: self.lr,
            seed: self.seed,
            device,
            loader_threads: self.loader_threads,
            precision: match self.precision {
                PrecisionName::F32 => ComputePrecision::F32,
                PrecisionName::Bf16 => ComputePrecision::Bf16,
            },
            out: self.out,
            resume: self.resume,
            validate_every: self.validate_every,
            validation_frames: self.validation_frames,
            samples,
            loss: LossConfig { unassigned, ..LossConfig::default() },
            optimizer: AdamWConfig { weight_decay: self.weight_decay, ..AdamWConfig::default() },
            command: std::env::args().collect::<Vec<_>>().join(" "),
        })
    }
}

/// A bar where somebody watches, else a line now and then.
struct Progress {
    bar: ProgressBar,
    is_watched: bool,
    last_line: Option<Instant>,
}

impl Progress {
    fn new() -> Self {
        let is_watched = std::io::stderr().is_terminal();
        let bar = if is_watched { ProgressBar::new(BAR_TICKS) } else { ProgressBar::hidden() };
        if let Ok(style) = ProgressStyle::with_template("{wide_bar} {percent}% {elapsed} eta {eta} {msg}") {
            bar.set_style(style);
        }
        Self { bar, is_watched, last_line: None }
    }
}

impl Observer for Progress {
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
        if self.is_watched {
            self.bar.set_position((report.progress * BAR_TICKS as f64) as u64);
            self.bar.set_message(text);
        } else if self.last_line.is_none_or(|last| last.elapsed() >= LINE_EVERY) {
            let remaining = report.seconds * (1.0 / report.progress.max(1e-6) - 1.0);
            eprintln!("{text}, {:.1} % done, {remaining:.0} s to go", 100.0 * report.progress);
            self.last_line = Some(Instant::now());
        }
    }

    fn validated(&mut self, step: u64, accuracy: &Accuracy) {
        let [ap_30, ap_50, ap_70] = accuracy.ap_global;
        let text = format!(
            "step {step}: AP@0.3/0.5/0.7 global {ap_30:.3} {ap_50:.3} {ap_70:.3} on {} frames",
            accuracy.frames
        );
        if self.is_watched { self.bar.println(text) } else { eprintln!("{text}") }
    }
}
