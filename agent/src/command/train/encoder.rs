//! `agent train encoder`.

use std::path::PathBuf;

use agent::localizer::SceneEncoderConfig;
use agent::localizer::training::{EncoderSummary, EncoderTrainConfig, train_encoder};
use agent::training::TrainingBar;

use super::options::{Options, bad, check_folders, command_line, write_card};

/// Train a scene encoder on sweeps that overlap; writes checkpoint, curve.csv, weights.safetensors and model-card.md.
///
/// Nothing of a town stays in it: a head for any town is trained on its features afterwards.
#[derive(Debug, clap::Args)]
pub(crate) struct Args {
    /// Folders of scenes, one town each; drives through the same town belong into one folder.
    #[arg(long, required = true, num_args = 1.., value_name = "DIR")]
    scenes: Vec<PathBuf>,
    /// Folders of scenes to validate on, one town each.
    #[arg(long, num_args = 1.., value_name = "DIR")]
    validation: Vec<PathBuf>,
    /// Network.
    #[arg(long, default_value = "lean", value_parser = parse_config)]
    config: SceneEncoderConfig,
    /// Pairs of sweeps of a step.
    #[arg(long, default_value_t = 4)]
    batch: usize,
    /// Highest learning rate.
    #[arg(long, default_value_t = 2e-3)]
    lr: f64,
    /// Steps between two validations and checkpoints.
    #[arg(long, default_value_t = 500)]
    validate_every: u64,
    #[command(flatten)]
    options: Options,
}

fn parse_config(name: &str) -> Result<SceneEncoderConfig, String> {
    SceneEncoderConfig::preset(name).ok_or_else(|| "there are lean and full".to_owned())
}

pub(crate) fn run(args: &Args) -> anyhow::Result<()> {
    let config = args.config()?;
    let bar = TrainingBar::default();
    let summary = train_encoder(
        &config,
        &mut |report| {
            let text = format!(
                "step {} loss {:.3} top-1 {:.1} % offset {:.2} m",
                report.step,
                report.loss,
                100.0 * report.accuracy.top1,
                report.accuracy.offset_m
            );
            bar.report(report.share_done, report.seconds, &text);
        },
        &mut |step, accuracy| {
            bar.say(&format!(
                "step {step}: validation top-1 {:.1} % offset {:.2} m",
                100.0 * accuracy.top1,
                accuracy.offset_m
            ));
        },
    )?;
    bar.finish();
    write_card(&config.out, &card(&config, &summary))?;
    if args.options.json {
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

impl Args {
    fn config(&self) -> anyhow::Result<EncoderTrainConfig> {
        if self.batch == 0 || self.validate_every == 0 {
            return Err(bad("--batch and --validate-every are above zero"));
        }
        check_folders(self.scenes.iter().chain(&self.validation))?;
        let (length, device) = self.options.start()?;
        Ok(EncoderTrainConfig {
            scenes: self.scenes.clone(),
            validation: self.validation.clone(),
            encoder: self.config.clone(),
            length,
            batch: self.batch,
            learning_rate: self.lr,
            seed: self.options.seed,
            device,
            precision: self.options.precision(),
            loader_threads: self.options.loader_threads,
            validate_every: self.validate_every,
            out: self.options.out.clone(),
            resume: self.options.resume,
        })
    }
}

fn card(config: &EncoderTrainConfig, summary: &EncoderSummary) -> String {
    let validation = summary.accuracy.map_or_else(String::new, |accuracy| {
        format!(
            "| validation | {:.1} % of cells find their match among those of two pairs, offset known to {:.2} m (L1) |\n",
            100.0 * accuracy.top1,
            accuracy.offset_m
        )
    });
    format!(
        "# Scene encoder `{}`\n\nSparse 3-D convolutions over voxels of {} m; trained on correspondences between overlapping sweeps.\n\n\
         | | |\n| --- | --- |\n| command | `{}` |\n| parameters | {} |\n| weights | SHA-256 `{}` |\n\
         | data | {} sweeps of {} towns, listing SHA-256 `{}` |\n| seed | {} |\n| steps | {} of {} pairs |\n\
         | numbers | {:?} |\n| time | {:.0} s |\n{validation}\nConfiguration:\n\n```json\n{}\n```\n",
        config.encoder.name,
        config.encoder.voxel_m,
        command_line(),
        summary.parameters,
        summary.sha256,
        summary.sweeps,
        config.scenes.len(),
        summary.data_sha256,
        config.seed,
        summary.steps,
        config.batch,
        config.precision,
        summary.seconds,
        serde_json::to_string_pretty(&config.encoder).unwrap_or_default()
    )
}
