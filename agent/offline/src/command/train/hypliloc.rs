//! `agent train hypliloc`: arguments, progress and model card.

use agent_offline::training::{HypLiLocReport, HypLiLocTrainConfig, train_hypliloc};
use perception::train::{ModelCard, TrainingBar, TrainingOptions};

use super::options::{SceneSweeps, SensorTurns, check_folders, print_left_out, run_config};

/// Train a small HypLiLoc on one scene; writes checkpoint, weights.safetensors and model-card.md.
///
/// All inputs lie on the device: 50 kB for each sweep. A length in minutes begins when they are computed.
#[derive(Debug, clap::Args)]
pub(crate) struct Args {
    #[command(flatten)]
    sweeps: SceneSweeps,
    #[command(flatten)]
    turns: SensorTurns,
    /// Sweeps per step.
    #[arg(long, default_value_t = 32)]
    batch: usize,
    /// Highest learning rate.
    #[arg(long, default_value_t = 1.5e-3)]
    lr: f64,
    #[command(flatten)]
    options: TrainingOptions,
}

pub(crate) fn run(args: &Args) -> anyhow::Result<()> {
    check_folders(&args.sweeps.dataset)?;
    let config = HypLiLocTrainConfig {
        scenes: args.sweeps.dataset.clone(),
        scene_name: args.sweeps.scene_name.clone(),
        turn_rad: args.turns.largest_rad()?,
        run: run_config(&args.options, args.batch, args.lr)?,
    };
    let bar = TrainingBar::of(config.run.length);
    let mut latest = None;
    let trained = train_hypliloc(&config, &mut |report| match *report {
        HypLiLocReport::Sampling(done, total) => bar.encoded(done, total),
        HypLiLocReport::Stepped {
            step,
            share_done,
            seconds,
            error_m,
            error_deg,
            place_losses: [points, image, fusion],
        } => {
            latest = Some((error_m, error_deg));
            let places = format!("places {points:.2} {image:.2} {fusion:.2}");
            let text = format!("step {step} error {error_m:.2} m {error_deg:.1} deg, {places}");
            bar.report(share_done, seconds, &text);
        }
    })?;
    bar.finish();
    print_left_out(&bar, &trained.data);
    let title = format!("HypLiLoc, small, of {}", config.scene_name);
    let mut card = ModelCard::new(
        &title,
        "Trained from random weights on the sweeps of one scene.",
    );
    card.trained(&config.run, &trained, "all sweeps", "sweeps");
    card.row(
        "augmentation",
        format_args!("turns up to {} degrees", args.turns.turn_deg),
    );
    if let Some((error_m, error_deg)) = latest {
        card.row(
            "mean error of the last steps, training sweeps",
            format!("{error_m:.2} m, {error_deg:.1} deg"),
        );
    }
    card.write(&config.run.out)?;
    args.options.print(&trained, &serde_json::json!({}))?;
    Ok(())
}
