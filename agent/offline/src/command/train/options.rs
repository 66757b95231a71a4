//! Options that all trainings of a localizer share.

use std::path::PathBuf;

use agent_offline::{Error, TrainingBar};
use perception::train::{Observe, TrainingEvent};

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
