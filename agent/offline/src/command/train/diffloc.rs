//! `agent train diffloc`: arguments, progress and model card.

use std::path::PathBuf;

use agent_offline::TrainingBar;
use agent_offline::training::{DiffLocTrainConfig, train_diffloc};
use localization::baselines::diffloc::DiffLocConfig;
use perception::train::{AdamWConfig, ModelCard, RunConfig, TrainingOptions};

use super::options::{SceneSweeps, SensorTurns, bad, check_folders, run_config, with_bar};

/// Decoupled weight decay: sweeps are few beside the parameters.
const WEIGHT_DECAY: f64 = 0.05;
/// Largest norm of a gradient.
const MAX_GRADIENT_NORM: f64 = 1.0;

/// Train DiffLoc, a baseline of the localizer, on one scene; writes checkpoint, curve.csv, weights.safetensors and
/// model-card.md.
#[derive(Debug, clap::Args)]
pub(crate) struct Args {
    #[command(flatten)]
    sweeps: SceneSweeps,
    /// Folders of sweeps of the same scene that are localized every 1000 steps.
    #[arg(long, num_args = 1.., value_name = "DIR")]
    validation: Vec<PathBuf>,
    /// Sweeps per step, in windows of three.
    #[arg(long, default_value_t = 48)]
    batch: usize,
    /// Highest learning rate.
    #[arg(long, default_value_t = 2e-3)]
    lr: f64,
    #[command(flatten)]
    turns: SensorTurns,
    /// Largest random shift of the sensor along each horizontal axis, metres.
    #[arg(long, value_name = "M", default_value_t = 1.0)]
    shift_m: f64,
    #[command(flatten)]
    options: TrainingOptions,
}

pub(crate) fn run(args: &Args) -> anyhow::Result<()> {
    let config = args.config()?;
    let bar = TrainingBar::of(config.run.length);
    let (summary, _) = with_bar(&bar, |observe| train_diffloc(&config, observe))?;
    let title = format!("DiffLoc of {}", config.network.scene_name);
    let about = "Pose regression by denoising diffusion, trained from random weights on the sweeps of one scene.";
    let mut card = ModelCard::new(&title, about);
    let data = format!("{} sweeps", summary.sweeps);
    card.trained(&config.run, &summary.trained, &data, "sweeps");
    let (turn_deg, shift_m) = (args.turns.turn_deg, args.shift_m);
    let turns = format!("turns up to {turn_deg} degrees, shifts up to {shift_m} m");
    card.row("augmentation", turns);
    let mask = "supervised: pixels in annotated boxes are not static";
    card.row("mask of static objects", mask);
    let mut more = serde_json::json!({});
    if let Some(accuracy) = summary.validation {
        card.row("validation", accuracy);
        more = serde_json::json!({"validation": accuracy});
    }
    card.configuration(&summary.network);
    card.write(&config.run.out)?;
    Ok(args.options.print(&summary.trained, &more)?)
}

impl Args {
    fn config(&self) -> anyhow::Result<DiffLocTrainConfig> {
        let shift_m = self.shift_m;
        if !(0.0..=10.0).contains(&shift_m) {
            let reason = format!("--shift-m is {shift_m}, must be 0 to 10 metres");
            return Err(bad(&reason));
        }
        check_folders(self.sweeps.dataset.iter().chain(&self.validation))?;
        let run = run_config(&self.options, self.batch, self.lr)?;
        let optimizer = AdamWConfig {
            weight_decay: WEIGHT_DECAY,
            max_gradient_norm: MAX_GRADIENT_NORM,
            ..run.optimizer
        };
        Ok(DiffLocTrainConfig {
            scenes: self.sweeps.dataset.clone(),
            validation: self.validation.clone(),
            network: DiffLocConfig {
                scene_name: self.sweeps.scene_name.clone(),
                ..DiffLocConfig::small()
            },
            turn_rad: self.turns.largest_rad()?,
            shift_m: self.shift_m,
            run: RunConfig { optimizer, ..run },
        })
    }
}
