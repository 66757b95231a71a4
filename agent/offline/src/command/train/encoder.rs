//! `agent train encoder`: arguments, progress and model card.

use std::path::PathBuf;

use agent_offline::TrainingBar;
use agent_offline::training::{EncoderAccuracy, EncoderSummary, EncoderTrainConfig, train_encoder};
use anyhow::Context;
use localization::pgc::SceneEncoderConfig;
use perception::train::{ModelCard, TrainingOptions};
use support::cli::BadInput;

use super::options::with_bar;

/// Train a scene encoder on sweeps that overlap; writes checkpoint, curve.csv, weights.safetensors and model-card.md.
///
/// The encoder is independent of the scene: a head for any scene is trained on its features afterwards.
#[derive(Debug, clap::Args)]
pub(crate) struct Args {
    /// Folders of sweeps, one scene each; drives through the same scene belong into one folder.
    #[arg(long, required = true, num_args = 1.., value_name = "DIR")]
    dataset: Vec<PathBuf>,
    /// Folders of sweeps to validate on, one scene each.
    #[arg(long, num_args = 1.., value_name = "DIR")]
    validation: Vec<PathBuf>,
    /// Network: lean or full.
    #[arg(long, default_value = "lean", value_parser = parse_network)]
    network: SceneEncoderConfig,
    /// Pairs of sweeps per step.
    #[arg(long, default_value_t = 4)]
    batch: usize,
    /// Highest learning rate.
    #[arg(long, default_value_t = 2e-3)]
    lr: f64,
    /// Steps between two validations and checkpoints.
    #[arg(long, default_value_t = 500)]
    validate_every_steps: u64,
    #[command(flatten)]
    options: TrainingOptions,
}

fn parse_network(name: &str) -> Result<SceneEncoderConfig, String> {
    SceneEncoderConfig::preset(name).ok_or_else(|| "must be lean or full".to_owned())
}

pub(crate) fn run(args: &Args) -> anyhow::Result<()> {
    let config = args.config()?;
    let bar = TrainingBar::of(config.run.length);
    let (summary, _) = with_bar(&bar, |observe| train_encoder(&config, observe))?;
    card(&config, &summary).write(&config.run.out)?;
    let more = serde_json::json!({"accuracy": summary.accuracy});
    Ok(args.options.print(&summary.trained, &more)?)
}

impl Args {
    fn config(&self) -> anyhow::Result<EncoderTrainConfig> {
        if self.validate_every_steps == 0 {
            return Err(BadInput::new("--validate-every-steps must be above zero").into());
        }
        // Before anything is computed.
        for folder in self.dataset.iter().chain(&self.validation) {
            std::fs::metadata(folder)
                .with_context(|| folder.display().to_string())
                .map_err(BadInput::of)?;
        }
        let run = self.options.run_config(self.batch, self.lr);
        Ok(EncoderTrainConfig {
            scenes: self.dataset.clone(),
            validation: self.validation.clone(),
            encoder: self.network.clone(),
            run: run.map_err(BadInput::of)?,
            validate_every: self.validate_every_steps,
        })
    }
}

fn card(config: &EncoderTrainConfig, summary: &EncoderSummary) -> ModelCard {
    let title = format!("Scene encoder `{}`", config.encoder.name);
    let about = format!(
        "Sparse 3-D convolutions over voxels of {} m; trained on correspondences between overlapping sweeps.",
        config.encoder.voxel_m
    );
    let mut card = ModelCard::new(&title, &about);
    let (sweeps, scenes) = (summary.sweeps, config.scenes.len());
    let data = format!("{sweeps} sweeps of {scenes} scenes");
    card.trained(&config.run, &summary.trained, &data, "pairs");
    if let Some(EncoderAccuracy { top1, offset_m }) = summary.accuracy {
        let text = format!(
            "{:.1} % of cells find their match among those of two pairs, offset error {offset_m:.2} m (L1)",
            100.0 * top1
        );
        card.row("validation", text);
    }
    card.configuration(&config.encoder);
    card
}
