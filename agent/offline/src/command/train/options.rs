//! Options that all trainings of a localizer share.

use std::path::PathBuf;

use agent_offline::{Error, TrainingBar};
use anyhow::Context;
use perception::train::{Observe, RunConfig, TrainingEvent, TrainingOptions};

use support::cli::BadInput;

/// Sweeps of one scene, to learn from.
#[derive(Debug, clap::Args)]
pub(crate) struct SceneOptions {
    /// Folders of sweeps, all of the same scene.
    #[arg(long, required = true, num_args = 1.., value_name = "DIR")]
    pub(crate) dataset: Vec<PathBuf>,
    /// Name of the scene, for messages and the model card.
    #[arg(long, default_value = "scene")]
    pub(crate) scene_name: String,
}

/// Error with exit code 2.
pub(crate) fn bad(reason: &str) -> anyhow::Error {
    BadInput::new(reason.to_owned()).into()
}

/// Configuration of a training; an invalid option is a usage error.
pub(crate) fn run_config(
    options: &TrainingOptions,
    batch: usize,
    learning_rate: f64,
) -> anyhow::Result<RunConfig> {
    let run = options.run_config(batch, learning_rate);
    Ok(run.map_err(BadInput::of)?)
}

/// Rejects missing folders and files before anything is computed.
pub(crate) fn check_folders<'a>(
    folders: impl IntoIterator<Item = &'a PathBuf>,
) -> anyhow::Result<()> {
    for folder in folders {
        std::fs::metadata(folder)
            .with_context(|| folder.display().to_string())
            .map_err(BadInput::of)?;
    }
    Ok(())
}

/// Trains with a bar; the result, and the means of the last report.
pub(crate) fn with_bar<T>(
    bar: &TrainingBar,
    train: impl FnOnce(&mut Observe<'_>) -> Result<T, Error>,
) -> anyhow::Result<(T, Vec<f64>)> {
    let mut latest = Vec::new();
    let trained = train(&mut |progress| {
        if let TrainingEvent::Stepped(report) = progress {
            latest.clone_from(&report.means);
        }
        bar.show_progress(progress);
    });
    bar.finish();
    Ok((trained?, latest))
}
