//! `agent train scene`: arguments, progress and model card.

use std::path::PathBuf;
use std::time::Duration;

use agent_offline::TrainingBar;
use agent_offline::training::{
    LeaveOut, SceneSummary, SceneTrainConfig, SweepAugmentation, train_scene,
};
use perception::train::{ModelCard, TrainingOptions};
use support::cli::BadInput;

use crate::command::scene_heads::check_one_map;

use super::options::{SceneOptions, with_bar};

/// Train the head of one scene on the features of a frozen encoder; writes checkpoint, curve.csv, weights.safetensors
/// and model-card.md.
#[derive(Debug, clap::Args)]
pub(crate) struct Args {
    #[command(flatten)]
    sweeps: SceneOptions,
    /// Folders of other sweeps of the scene to validate on.
    #[arg(long, num_args = 1.., value_name = "DIR")]
    validation: Vec<PathBuf>,
    /// Number of sweeps of a validation.
    #[arg(long, value_name = "N", default_value_t = 120, requires = "validation")]
    validation_sweeps: usize,
    /// Seconds between two validations and checkpoints.
    #[arg(long, default_value_t = 120)]
    validate_every_s: u64,
    /// Weights of the encoder: a scene encoder, or a detector, whose backbone then serves both.
    #[arg(long, value_name = "FILE")]
    encoder: PathBuf,
    /// Head of the same scene to start from, for example to add sweeps of another weather or season; its sizes replace
    /// --position-clusters, --centres, --width, --blocks and --no-refiner, its name --scene-name. Name sweeps that it
    /// knows among --dataset too.
    #[arg(long, value_name = "FILE", conflicts_with_all = ["position_clusters", "centres", "width", "blocks", "no_refiner", "scene_name"])]
    init: Option<PathBuf>,
    /// Clusters of sensor positions that a sweep is classified into.
    #[arg(long, default_value_t = 50)]
    position_clusters: i64,
    /// Clusters of world coordinates, the reference points of a cell's offset.
    #[arg(long, default_value_t = 500)]
    centres: i64,
    /// Channels of the head.
    #[arg(long, default_value_t = 512)]
    width: i64,
    /// Residual blocks of three layers.
    #[arg(long, default_value_t = 3)]
    blocks: usize,
    /// Train no refinement network.
    #[arg(long)]
    no_refiner: bool,
    /// Copies of every sweep, all but the first rotated and subsampled at random.
    #[arg(long, default_value_t = 1)]
    copies: usize,
    /// Largest rotation of such copies, degrees.
    #[arg(long, value_name = "DEG", default_value_t = 10.0, requires = "copies")]
    turn_deg: f64,
    /// Leave out a share of the sweeps in the middle of the training: those with an even loss (RSD), or random ones, its
    /// control. Trainings of fewer than some 14 passes are too short for it.
    #[arg(long, value_name = "CHOICE")]
    leave_out: Option<LeaveOut>,
    /// Cells per step.
    #[arg(long, default_value_t = 4096)]
    batch: usize,
    /// Highest learning rate.
    #[arg(long, default_value_t = 2e-3)]
    lr: f64,
    #[command(flatten)]
    options: TrainingOptions,
}

pub(crate) fn run(args: &Args) -> anyhow::Result<()> {
    let config = args.config()?;
    let bar = TrainingBar::including_encoding(config.run.length);
    let (summary, _) = with_bar(&bar, |observe| train_scene(&config, observe))?;
    card(&config, &summary).write(&config.run.out)?;
    let more = serde_json::json!({
        "preparing_seconds": summary.preparing_seconds,
        "accuracy": summary.accuracy,
        "cells_shown": summary.cells_shown,
    });
    Ok(args.options.print(&summary.trained, &more)?)
}

impl Args {
    fn config(&self) -> anyhow::Result<SceneTrainConfig> {
        if self.copies == 0 || self.validation_sweeps == 0 {
            let reason = "--copies and --validation-sweeps must be above zero";
            return Err(BadInput::new(reason).into());
        }
        check_one_map(&[&self.sweeps.dataset[..], &self.validation[..]].concat())?;
        let run = self.options.run_config(self.batch, self.lr);
        Ok(SceneTrainConfig {
            scenes: self.sweeps.dataset.clone(),
            validation: self.validation.clone(),
            validation_sweeps: self.validation_sweeps,
            encoder: self.encoder.clone(),
            init: self.init.clone(),
            scene_name: self.sweeps.scene_name.clone(),
            classes: self.position_clusters,
            centres: self.centres,
            width: self.width,
            blocks: self.blocks,
            refiner: !self.no_refiner,
            augmentation: SweepAugmentation {
                copies: self.copies,
                turn_rad: self.turn_deg.to_radians(),
                keep: 0.7,
            },
            redundancy: self.leave_out,
            run: run.map_err(BadInput::of)?,
            validate_every: Duration::from_secs(self.validate_every_s),
        })
    }
}

fn card(config: &SceneTrainConfig, summary: &SceneSummary) -> ModelCard {
    let title = format!("Scene head of {}", summary.scene_name);
    let about = "World coordinates of cells on the features of a frozen encoder.";
    let mut card = ModelCard::new(&title, about);
    let data = format!("{} sweeps", summary.sweeps);
    card.trained(&config.run, &summary.trained, &data, "cells");
    let preparing = format!("{:.0} s", summary.preparing_seconds);
    card.row("of which reading and encoding", preparing);
    if let Some(accuracy) = summary.accuracy {
        let text = format!(
            "poses: median {:.3} m and {:.3} degrees, under 3 m {:.1} %, under 1 m {:.1} %; cells: median {:.2} m (L1)",
            accuracy.pose_p50_m,
            accuracy.pose_p50_deg,
            100.0 * accuracy.success_3m,
            100.0 * accuracy.success_1m,
            accuracy.cell_p50_m
        );
        card.row("validation", text);
    }
    card
}
