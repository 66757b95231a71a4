//! `agent train encoder`: arguments, progress and model card.

use std::path::PathBuf;

use agent_offline::training::{
    EncoderAccuracy, EncoderReport, EncoderSummary, EncoderTrainConfig, train_encoder,
};
use localization::pgc::SceneEncoderConfig;
use perception::train::{ModelCard, TrainingBar, TrainingOptions};

use super::options::{bad, check_folders, print_left_out, run_config};

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
    let summary = train_encoder(&config, &mut |report| tell(&bar, report))?;
    bar.finish();
    card(&config, &summary).write(&config.run.out)?;
    args.options.print(
        &summary.trained,
        &serde_json::json!({"accuracy": summary.accuracy}),
    )?;
    Ok(())
}

fn tell(bar: &TrainingBar, report: &EncoderReport) {
    match report {
        EncoderReport::Read(data) => print_left_out(bar, data),
        EncoderReport::Stepped {
            step,
            share_done,
            seconds,
            loss,
            accuracy,
        } => {
            let EncoderAccuracy { top1, offset_m } = accuracy;
            let text = format!(
                "step {step} loss {loss:.3} top-1 {:.1} % offset {offset_m:.2} m",
                100.0 * top1
            );
            bar.report(*share_done, *seconds, &text);
        }
        EncoderReport::Validated(step, EncoderAccuracy { top1, offset_m }) => {
            bar.print_line(&format!(
                "step {step}: validation top-1 {:.1} % offset {offset_m:.2} m",
                100.0 * top1
            ));
        }
    }
}

impl Args {
    fn config(&self) -> anyhow::Result<EncoderTrainConfig> {
        if self.validate_every_steps == 0 {
            return Err(bad("--validate-every-steps must be above zero"));
        }
        check_folders(self.dataset.iter().chain(&self.validation))?;
        Ok(EncoderTrainConfig {
            scenes: self.dataset.clone(),
            validation: self.validation.clone(),
            encoder: self.network.clone(),
            run: run_config(&self.options, self.batch, self.lr)?,
            validate_every: self.validate_every_steps,
        })
    }
}

fn card(config: &EncoderTrainConfig, summary: &EncoderSummary) -> ModelCard {
    let mut card = ModelCard::new(
        &format!("Scene encoder `{}`", config.encoder.name),
        &format!(
            "Sparse 3-D convolutions over voxels of {} m; trained on correspondences between overlapping sweeps.",
            config.encoder.voxel_m
        ),
    );
    let data = format!(
        "{} sweeps of {} scenes",
        summary.sweeps,
        config.scenes.len()
    );
    card.trained(&config.run, &summary.trained, &data, "pairs");
    if let Some(accuracy) = summary.accuracy {
        card.row(
            "validation",
            format_args!(
                "{:.1} % of cells find their match among those of two pairs, offset error {:.2} m (L1)",
                100.0 * accuracy.top1,
                accuracy.offset_m
            ),
        );
    }
    card.configuration(&config.encoder);
    card
}
