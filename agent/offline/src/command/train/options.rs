//! What the trainings of a localizer ask of the command line alike.

use std::path::PathBuf;

use anyhow::Context;
use perception::train::{DataListing, RunConfig, TrainingBar, TrainingOptions};

use support::cli::BadInput;

/// An error for which the exit code is 2.
pub(crate) fn bad(reason: &str) -> anyhow::Error {
    BadInput::new(reason.to_owned()).into()
}

/// What a training is told; a fault of the options is one of usage.
pub(crate) fn run_config(options: &TrainingOptions, batch: usize, learning_rate: f64) -> anyhow::Result<RunConfig> {
    Ok(options.run_config(batch, learning_rate).map_err(BadInput::of)?)
}

/// Refuses folders that are not there before anything is computed.
pub(crate) fn check_folders<'a>(folders: impl IntoIterator<Item = &'a PathBuf>) -> anyhow::Result<()> {
    for folder in folders {
        std::fs::read_dir(folder).with_context(|| folder.display().to_string()).map_err(BadInput::of)?;
    }
    Ok(())
}

/// Says what of the data is of no use.
pub(crate) fn say_left_out(bar: &TrainingBar, data: &DataListing) {
    data.left_out().iter().for_each(|text| bar.say(text));
}
