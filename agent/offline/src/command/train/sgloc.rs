//! `agent train sgloc`: arguments, progress and model card.

use std::path::PathBuf;

use agent_offline::TrainingBar;
use agent_offline::training::{SgLocTrainConfig, train_sgloc};
use perception::train::{ModelCard, TrainingOptions};
use support::cli::BadInput;

use crate::command::scene_heads::check_one_map;

use super::options::{SceneOptions, with_bar};

/// Train SGLoc's head on one scene, on a frozen encoder; writes checkpoint, weights.safetensors and model-card.md.
#[derive(Debug, clap::Args)]
pub(crate) struct Args {
    #[command(flatten)]
    sweeps: SceneOptions,
    /// Weights of the frozen encoder, output of `agent train encoder`.
    #[arg(long, value_name = "FILE")]
    encoder: PathBuf,
    /// Sweeps per step, 400 cells for each.
    #[arg(long, default_value_t = 12)]
    batch: usize,
    /// Highest learning rate.
    #[arg(long, default_value_t = 2e-3)]
    lr: f64,
    #[command(flatten)]
    options: TrainingOptions,
}

pub(crate) fn run(args: &Args) -> anyhow::Result<()> {
    check_one_map(&args.sweeps.dataset)?;
    let run = args.options.run_config(args.batch, args.lr);
    let config = SgLocTrainConfig {
        scenes: args.sweeps.dataset.clone(),
        scene_name: args.sweeps.scene_name.clone(),
        encoder: args.encoder.clone(),
        run: run.map_err(BadInput::of)?,
    };
    let bar = TrainingBar::of(config.run.length);
    let (trained, means) = with_bar(&bar, |observe| train_sgloc(&config, observe))?;
    let title = format!("SGLoc, small, of {}", config.scene_name);
    let about = "Head on the features of a frozen encoder, trained on the sweeps of one scene.";
    let mut card = ModelCard::new(&title, about);
    card.trained(&config.run, &trained, "all sweeps", "sweeps");
    if let [error_m] = means[..] {
        let name = "mean L1 error of the last steps, training cells";
        card.row(name, format_args!("{error_m:.2} m"));
    }
    card.write(&config.run.out)?;
    Ok(args.options.print(&trained, &serde_json::json!({}))?)
}
