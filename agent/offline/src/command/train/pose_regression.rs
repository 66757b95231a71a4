//! `agent train diffloc` and `agent train hypliloc`: arguments, progress and model card.

use std::path::PathBuf;

use agent_offline::training::{PoseRegressionConfig, PoseRegressionSummary};
use agent_offline::{Error, TrainingBar};
use perception::train::{ModelCard, Observe, RateSchedule, TrainingOptions};
use support::cli::BadInput;

use crate::command::scene_heads::check_one_map;

use super::options::{SceneOptions, with_bar};

/// Decoupled weight decay: sweeps are few beside the parameters.
const WEIGHT_DECAY: f64 = 0.05;
/// Largest norm of a gradient.
const MAX_GRADIENT_NORM: f64 = 1.0;

#[derive(Debug, clap::Args)]
pub(crate) struct Args {
    #[command(flatten)]
    sweeps: SceneOptions,
    /// Folders of sweeps of the same scene that are localized every 1000 steps.
    #[arg(long, num_args = 1.., value_name = "DIR")]
    validation: Vec<PathBuf>,
    /// Weights of the frozen encoder, output of `agent train encoder`.
    #[arg(long, value_name = "FILE")]
    encoder: PathBuf,
    /// Sweeps per step.
    #[arg(long, default_value_t = 96)]
    batch: usize,
    /// Learning rate of the first four fifths; then it falls.
    #[arg(long, default_value_t = 1e-3)]
    lr: f64,
    /// Largest random turn of the sensor to either side, degrees, in whole sectors of 11.25; vehicles in lanes head as
    /// those of the training.
    #[arg(long, value_name = "DEG", default_value_t = 12.0)]
    turn_deg: f64,
    #[command(flatten)]
    options: TrainingOptions,
}

/// Training of one of the networks.
type Train = fn(&PoseRegressionConfig, &mut Observe<'_>) -> Result<PoseRegressionSummary, Error>;

/// Trains the network `name`.
pub(crate) fn run(args: &Args, name: &str, train: Train) -> anyhow::Result<()> {
    let config = args.config()?;
    let bar = TrainingBar::of(config.run.length);
    let (summary, _) = with_bar(&bar, |observe| train(&config, observe))?;
    let title = format!("{name}, small, of {}", config.scene_name);
    let about =
        "Pose regression on tokens of a frozen encoder, trained on the sweeps of one scene.";
    let mut card = ModelCard::new(&title, about);
    let data = format!("{} sweeps", summary.sweeps);
    card.trained(&config.run, &summary.trained, &data, "sweeps");
    let turns = format!("turns up to {} degrees, lost tokens, noise", args.turn_deg);
    card.row("augmentation", turns);
    let mut more = serde_json::json!({});
    if let Some(accuracy) = summary.validation {
        card.row("validation", accuracy);
        more = serde_json::json!({"validation": accuracy});
    }
    card.configuration(&summary.network);
    card.write(&config.run.out)?;
    Ok(args.options.print(&summary.trained, &more)?)
}

impl Args {
    fn config(&self) -> anyhow::Result<PoseRegressionConfig> {
        let turn_deg = self.turn_deg;
        // A range, so that NaN is refused too.
        if !(0.0..=180.0).contains(&turn_deg) {
            let reason = format!("--turn-deg is {turn_deg}, must be 0 to 180 degrees");
            return Err(BadInput::new(reason).into());
        }
        check_one_map(&[&self.sweeps.dataset[..], &self.validation[..]].concat())?;
        let run = self.options.run_config(self.batch, self.lr);
        let mut run = run.map_err(BadInput::of)?;
        run.optimizer.weight_decay = WEIGHT_DECAY;
        run.optimizer.max_gradient_norm = MAX_GRADIENT_NORM;
        run.schedule = RateSchedule::HeldRate;
        Ok(PoseRegressionConfig {
            scenes: self.sweeps.dataset.clone(),
            validation: self.validation.clone(),
            scene_name: self.sweeps.scene_name.clone(),
            encoder: self.encoder.clone(),
            turn_rad: turn_deg.to_radians(),
            run,
        })
    }
}
