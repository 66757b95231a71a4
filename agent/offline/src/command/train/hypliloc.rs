//! `agent train hypliloc`: arguments, progress and model card.

use agent_offline::TrainingBar;
use agent_offline::training::{HypLiLocTrainConfig, train_hypliloc};
use perception::train::{ModelCard, TrainingOptions};

use super::options::{SceneSweeps, SensorTurns, check_folders, run_config, with_bar};

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
    let (trained, means) = with_bar(&bar, |observe| train_hypliloc(&config, observe))?;
    let title = format!("HypLiLoc, small, of {}", config.scene_name);
    let about = "Trained from random weights on the sweeps of one scene.";
    let mut card = ModelCard::new(&title, about);
    card.trained(&config.run, &trained, "all sweeps", "sweeps");
    let turns = format!("turns up to {} degrees", args.turns.turn_deg);
    card.row("augmentation", turns);
    if let [error_m, error_deg, ..] = means[..] {
        let name = "mean error of the last steps, training sweeps";
        card.row(name, format_args!("{error_m:.2} m, {error_deg:.1} deg"));
    }
    card.write(&config.run.out)?;
    Ok(args.options.print(&trained, &serde_json::json!({}))?)
}
