//! Generated data set of an experiment: made once, also where several slices start together.

use std::fs::{self, File};
use std::io;
use std::path::Path;

use anyhow::{Context, Result};
use simulator::generate::{self, Subset, SynthOptions};
use support::output;
use terminal::progress;

use super::remove;
use crate::experiment::spec::Experiment;

/// Options with which the data set of the experiment is generated.
fn generator(experiment: &Experiment) -> Option<SynthOptions> {
    let generate = experiment.generate.as_ref()?;
    let [fewest, most] = generate.vehicles;
    Some(SynthOptions {
        frames: generate.frames,
        scenes: generate.scenes,
        agents: fewest..=most,
        ..SynthOptions::new(Subset::V2vdet, generate.seed, experiment.dataset.clone())
    })
}

/// True if no data set is requested, or it exists.
pub(super) fn is_generated(experiment: &Experiment) -> Result<bool> {
    let kept = generator(experiment).map_or(Ok(true), |options| generate::are_kept(&options));
    kept.context("generate")
}

/// Generates the data set, unless it is there.
pub(in crate::experiment) fn generate(experiment: &Experiment) -> Result<()> {
    let Some(options) = generator(experiment) else {
        return Ok(());
    };
    if is_generated(experiment)? {
        return Ok(());
    }
    // Of two slices that start together one generates, the other waits for it.
    let path = options.out.with_added_extension("lock");
    let lock = lock(&path).with_context(|| path.display().to_string())?;
    // Looked at again under the lock: the other slice may have made it meanwhile.
    if !is_generated(experiment)? {
        let (scenes, folder) = (options.scenes, options.out.display());
        output::note(format_args!("generating {scenes} scenarios into {folder}"));
        let bar = progress::percent_bar(scenes);
        let generated =
            generate::generate_whole(&options, &|thousandths| bar.set_position(thousandths));
        bar.finish_and_clear();
        generated.context("generate")?;
    }
    drop(lock);
    // A process that waits at the removed file still gets its lock, and finds the data then.
    remove(&path)
}

/// A lock that other processes wait for, on this host and on those that share the folder, until it is dropped.
fn lock(path: &Path) -> io::Result<File> {
    if let Some(folder) = path.parent() {
        fs::create_dir_all(folder)?;
    }
    let file = File::create(path)?;
    file.lock()?;
    Ok(file)
}
