//! `agent train end-to-end`.

use std::path::PathBuf;

use agent::localizer::training::{EndToEndTrainConfig, train_end_to_end};
use agent::localizer::{EndToEndKind, SceneEncoderConfig};
use agent::training::TrainingBar;

use super::options::{Options, bad, check_folders, command_line, write_card};

/// Train a competitor of the localizer on one town, from nothing; writes weights.safetensors and model-card.md.
#[derive(Debug, clap::Args)]
pub(crate) struct Args {
    /// Folders of scenes, all of the same town.
    #[arg(long, required = true, num_args = 1.., value_name = "DIR")]
    scenes: Vec<PathBuf>,
    /// What is regressed: scene-coordinates stands for SGLoc, pose for HypLiLoc and DiffLoc.
    #[arg(long, value_enum)]
    regresses: Regresses,
    /// Name of the town, for messages and the model card.
    #[arg(long, default_value = "town")]
    town: String,
    /// Sweeps of a step.
    #[arg(long, default_value_t = 6)]
    batch: usize,
    /// Highest learning rate.
    #[arg(long, default_value_t = 1e-3)]
    lr: f64,
    #[command(flatten)]
    options: Options,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, clap::ValueEnum)]
enum Regresses {
    /// World coordinates of cells, without classification and confidence.
    SceneCoordinates,
    /// The pose itself.
    Pose,
}

pub(crate) fn run(args: &Args) -> anyhow::Result<()> {
    if args.batch == 0 {
        return Err(bad("--batch is above zero"));
    }
    check_folders(&args.scenes)?;
    let (length, device) = args.options.start()?;
    let config = EndToEndTrainConfig {
        scenes: args.scenes.clone(),
        regresses: match args.regresses {
            Regresses::SceneCoordinates => EndToEndKind::SceneCoordinates,
            Regresses::Pose => EndToEndKind::Pose,
        },
        town: args.town.clone(),
        encoder: SceneEncoderConfig::lean(),
        length,
        batch: args.batch,
        learning_rate: args.lr,
        seed: args.options.seed,
        device,
        precision: args.options.precision(),
        loader_threads: args.options.loader_threads,
        out: args.options.out.clone(),
    };
    let bar = TrainingBar::default();
    let summary = train_end_to_end(&config, &mut |report| {
        bar.report(report.share_done, report.seconds, &format!("step {} error {:.2} m", report.step, report.error_m));
    })?;
    bar.finish();
    let card = format!(
        "# End-to-end regressor of {}: {:?}\n\n| | |\n| --- | --- |\n| command | `{}` |\n| weights | SHA-256 `{}` |\n\
         | seed | {} |\n| steps | {} of {} sweeps |\n| time | {:.0} s |\n",
        config.town,
        config.regresses,
        command_line(),
        summary.sha256,
        config.seed,
        summary.steps,
        config.batch,
        summary.seconds
    );
    write_card(&config.out, &card)?;
    if args.options.json {
        let report = serde_json::json!({"steps": summary.steps, "seconds": summary.seconds,
            "weights": summary.weights, "sha256": summary.sha256});
        println!("{report}");
    } else {
        println!("{} steps in {:.0} s: {}", summary.steps, summary.seconds, summary.weights.display());
    }
    Ok(())
}
