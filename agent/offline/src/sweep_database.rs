//! Descriptors and true poses of the sweeps of drives, for retrieval.

use crate::{Error, Result};
use std::collections::HashMap;
use std::path::{Path, PathBuf};

use dataset::frame::Frame;
use dataset::{
    Dataset, IntensityScale, LeftOut, LoadOptions, Problem, ReadError, Scenario, findings,
};
use localization::pgc::LocalizerError;
use nalgebra::Isometry3;
use protocol::{PointCloud, Pose};

/// Descriptor and pose of each sweep of the drives that `describe` gives a descriptor; `progress` gets the number of
/// sweeps done and of all. Sweeps that cannot be read or have no pose are left out and counted in `left_out`.
///
/// # Errors
/// [`Error`] names the file, or the folders where no sweep is described.
pub fn described_sweeps<D, E: Into<LocalizerError>>(
    folders: &[PathBuf],
    describe: &mut dyn FnMut(&PointCloud) -> Result<Option<D>, E>,
    left_out: &mut LeftOut,
    progress: &mut dyn FnMut(usize, usize),
) -> Result<Vec<(D, Isometry3<f64>)>> {
    let datasets = folders.iter().map(|folder| open_drives(folder, left_out));
    let datasets: Vec<_> = datasets.collect::<Result<_>>()?;
    let scenarios = datasets.iter().flat_map(|dataset| &dataset.scenarios);
    let all: Vec<_> = scenarios
        .flat_map(|scenario| present_sweeps(scenario).map(move |sweep| (scenario, sweep)))
        .collect();
    let mut sweeps = Vec::new();
    for (place, &(scenario, (agent, tick))) in all.iter().enumerate() {
        progress(place + 1, all.len());
        match posed(scenario, agent, tick, &LoadOptions::default()) {
            Ok((frame, pose)) => {
                let described = describe(&frame.points).map_err(Into::into)?;
                sweeps.extend(described.map(|described| (described, pose.isometry())));
            }
            Err(error) => left_out.add_unreadable(agent, Problem::from(&error)),
        }
    }
    match sweeps.is_empty() {
        true => Err(Error::NoSweeps(folders.to_vec(), left_out.reasons())),
        false => Ok(sweeps),
    }
}

/// Opens the drives of a folder, and adds what is wrong with them as a whole: files that are not used, and findings about
/// those that are.
///
/// # Errors
/// [`Error`] names the folder that cannot be opened.
pub fn open_drives(folder: &Path, left_out: &mut LeftOut) -> Result<Dataset> {
    let drives = dataset::open(folder)?;
    left_out.add_files(&drives.problems);
    let findings = findings::sampled(&drives.scenarios, IntensityScale::AUTO, None);
    left_out.add_findings(findings);
    Ok(drives)
}

/// The statement that two of some folders, or one that is given twice, have the same scenario; `None` if none have.
///
/// # Errors
/// [`Error`] names the folder that cannot be opened.
pub fn repeated<'a>(folders: impl IntoIterator<Item = &'a PathBuf>) -> Result<Option<String>> {
    let mut folder_of = HashMap::new();
    for (place, folder) in folders.into_iter().enumerate() {
        for scenario in dataset::open(folder)?.scenarios {
            let first = first_sweep(&scenario);
            let other = first.and_then(|first| folder_of.insert(first, (place, folder)));
            if let Some((_, other)) = other.filter(|(other, _)| *other != place) {
                let (other, folder, name) = (other.display(), folder.display(), scenario.name);
                let reason =
                    format!("{other} and {folder} both have the sweeps of scenario {name}");
                return Ok(Some(reason));
            }
        }
    }
    Ok(None)
}

/// File and capture time (nanoseconds) of a scenario's first sweep, by whatever path its folder was opened.
fn first_sweep(scenario: &Scenario) -> Option<(PathBuf, u64)> {
    let file = scenario.points_path(0, 0, None).ok()?;
    let folder = file.parent()?.canonicalize().ok()?;
    let nanos = scenario.ticks.first()?.capture_nanos;
    Some((folder.join(file.file_name()?), nanos))
}

/// Agent and tick of all sweeps of a scenario, vehicle by vehicle, in the order of time.
pub fn present_sweeps(scenario: &Scenario) -> impl Iterator<Item = (usize, usize)> {
    let all = (0..scenario.agents.len())
        .flat_map(move |agent| (0..scenario.ticks.len()).map(move |tick| (agent, tick)));
    all.filter(move |&(agent, tick)| scenario.is_present(agent, tick))
}

/// A sweep and its true pose.
pub(crate) fn posed(
    scenario: &Scenario,
    agent: usize,
    tick: usize,
    options: &LoadOptions,
) -> Result<(Frame, Pose), ReadError> {
    let frame = scenario.load(agent, tick, options)?;
    let Some(pose) = frame.world_from_lidar else {
        let path = scenario.points_path(agent, tick, None)?;
        let reason = "there is no pose for this sweep";
        return Err(ReadError::malformed(&path, reason));
    };
    Ok((frame, pose))
}
