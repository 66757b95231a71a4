//! `agent train end-to-end`: arguments, progress and model card.

use std::path::PathBuf;

use agent_offline::training::{EncoderStart, EndToEndReport, EndToEndTrainConfig, train_end_to_end};
use localization::competitors::EndToEndKind;
use localization::pgc::SceneEncoderConfig;
use perception::train::{ModelCard, TrainingBar, TrainingOptions};

use super::options::{SceneSweeps, check_folders, print_left_out, run_config};

/// Train a competitor of the localizer on one scene; writes checkpoint, weights.safetensors and model-card.md.
#[derive(Debug, clap::Args)]
pub(crate) struct Args {
    #[command(flatten)]
    sweeps: SceneSweeps,
    /// Target of the regression: coordinates of cells after SGLoc, or the pose itself from pooled features.
    #[arg(long, value_enum)]
    regresses: Regresses,
    /// Weights of a frozen encoder [default: the encoder is trained from random weights with the rest].
    #[arg(long, value_name = "FILE")]
    encoder: Option<PathBuf>,
    /// Sweeps per step; with --encoder, 400 cells for each.
    #[arg(long, default_value_t = 6)]
    batch: usize,
    /// Highest learning rate.
    #[arg(long, default_value_t = 1e-3)]
    lr: f64,
    #[command(flatten)]
    options: TrainingOptions,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, clap::ValueEnum)]
enum Regresses {
    /// World coordinates of cells, after SGLoc.
    #[value(name = "sgloc")]
    SgLoc,
    /// The pose itself.
    Pose,
}

pub(crate) fn run(args: &Args) -> anyhow::Result<()> {
    check_folders(&args.sweeps.scenes)?;
    let config = EndToEndTrainConfig {
        scenes: args.sweeps.scenes.clone(),
        regresses: match args.regresses {
            Regresses::SgLoc => EndToEndKind::SgLoc,
            Regresses::Pose => EndToEndKind::Pose,
        },
        scene_name: args.sweeps.scene_name.clone(),
        encoder: match &args.encoder {
            Some(path) => EncoderStart::Frozen(path.clone()),
            None => EncoderStart::Untrained(SceneEncoderConfig::lean()),
        },
        run: run_config(&args.options, args.batch, args.lr)?,
    };
    let bar = TrainingBar::of(config.run.length);
    let trained = train_end_to_end(&config, &mut |report| match report {
        EndToEndReport::Encoding(done, total) => bar.encoded(*done, *total),
        EndToEndReport::Stepped { step, share_done, seconds, error_m } => {
            bar.report(*share_done, *seconds, &format!("step {step} error {error_m:.2} m"));
        }
    })?;
    bar.finish();
    print_left_out(&bar, &trained.data);
    let title = format!("End-to-end regressor of {}: {:?}", config.scene_name, config.regresses);
    let how = match args.encoder {
        Some(_) => "Last layers on the features of a frozen encoder, trained on the sweeps of one scene.",
        None => "Trained from random weights on the sweeps of one scene.",
    };
    let mut card = ModelCard::new(&title, how);
    card.trained(&config.run, &trained, "all sweeps", "sweeps");
    card.write(&config.run.out)?;
    args.options.print(&trained, &serde_json::json!({}))?;
    Ok(())
}
