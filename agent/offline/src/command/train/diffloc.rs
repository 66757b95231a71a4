//! `agent train diffloc`: arguments, progress and model card.

use std::path::PathBuf;

use agent_offline::training::{DiffLocAccuracy, DiffLocReport, DiffLocTrainConfig, train_diffloc};
use localization::baselines::diffloc::DiffLocConfig;
use perception::train::{AdamWConfig, ModelCard, RunConfig, TrainingBar, TrainingOptions};

use super::options::{SceneSweeps, SensorTurns, bad, check_folders, print_left_out, run_config};

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
    let summary = train_diffloc(&config, &mut |report| show(&bar, report))?;
    bar.finish();
    print_left_out(&bar, &summary.trained.data);
    let title = format!("DiffLoc of {}", config.network.scene_name);
    let mut card = ModelCard::new(
        &title,
        "Pose regression by denoising diffusion, trained from random weights on the sweeps of one scene.",
    );
    let data = format!("{} sweeps", summary.sweeps);
    card.trained(&config.run, &summary.trained, &data, "sweeps");
    let (turn_deg, shift_m) = (args.turns.turn_deg, args.shift_m);
    let turns = format!("turns up to {turn_deg} degrees, shifts up to {shift_m} m");
    card.row("augmentation", turns);
    card.row(
        "mask of static objects",
        "supervised: pixels in annotated boxes are not static",
    );
    if let Some(accuracy) = summary.validation {
        card.row("validation", text(&accuracy));
    }
    card.configuration(&summary.network);
    card.write(&config.run.out)?;
    let more = summary.validation.map_or(serde_json::json!({}), |DiffLocAccuracy { p50_m, success_3m }| {
        serde_json::json!({"validation": {"p50_m": p50_m, "success_3m": success_3m}})
    });
    args.options.print(&summary.trained, &more)?;
    Ok(())
}

impl Args {
    fn config(&self) -> anyhow::Result<DiffLocTrainConfig> {
        let shift_m = self.shift_m;
        if !(0.0..=10.0).contains(&shift_m) {
            return Err(bad(&format!(
                "--shift-m is {shift_m}, must be 0 to 10 metres"
            )));
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

fn show(bar: &TrainingBar, report: &DiffLocReport) {
    match report {
        DiffLocReport::Imaging(done, total) => bar.encoded(*done, *total),
        DiffLocReport::Stepped {
            step,
            share_done,
            seconds,
            pose_l1,
            place_loss,
            accuracy,
        } => {
            bar.report(
                *share_done,
                *seconds,
                &format!(
                    "step {step} poses {pose_l1:.3} places {place_loss:.2}, batch {}",
                    text(accuracy)
                ),
            );
        }
        DiffLocReport::Validated(seconds, accuracy) => {
            bar.print_line(&format!("{seconds:.0} s: validation {}", text(accuracy)));
        }
    }
}

fn text(accuracy: &DiffLocAccuracy) -> String {
    format!(
        "median {:.2} m, {:.1} % under 3 m",
        accuracy.p50_m,
        100.0 * accuracy.success_3m
    )
}
