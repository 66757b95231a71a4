//! Database of sweeps for retrieval, from drives with true poses.

use crate::Error;
use std::path::Path;

use dataset::{LeftOut, LoadOptions, Problem, ReadError, Scenario};
use localization::baselines::{DescribedSweep, SweepDatabase};
use localization::pgc::{Localizer, stopwatch};

/// Describes every sweep of the drives; `progress` gets the number of sweeps done and of all. Sweeps that cannot be
/// read or have no pose are left out and counted in `left_out`.
///
/// # Errors
/// [`Error`] names the file.
pub fn read_database(
    folders: &[impl AsRef<Path>],
    localizer: &Localizer,
    left_out: &mut LeftOut,
    progress: &mut dyn FnMut(usize, usize),
) -> Result<SweepDatabase, Error> {
    let datasets = folders.iter().map(|folder| dataset::open(folder.as_ref()));
    let datasets: Vec<_> = datasets.collect::<Result<_, _>>()?;
    for dataset in &datasets {
        left_out.add_files(&dataset.problems);
    }
    let scenarios = datasets.iter().flat_map(|dataset| &dataset.scenarios);
    let all: Vec<_> = scenarios
        .flat_map(|scenario| present_sweeps(scenario).map(move |sweep| (scenario, sweep)))
        .collect();
    let mut sweeps = Vec::new();
    for (place, &(scenario, (agent, tick))) in all.iter().enumerate() {
        progress(place + 1, all.len());
        match described(scenario, agent, tick, localizer) {
            Ok(sweep) => sweeps.extend(sweep),
            Err(Error::Read(error)) => left_out.add_unreadable(agent, Problem::from(&error)),
            Err(error) => return Err(error),
        }
    }
    SweepDatabase::new(&sweeps).ok_or_else(|| {
        let folders = folders.iter().map(|folder| folder.as_ref().to_owned());
        Error::NoSweeps(folders.collect(), left_out.reasons())
    })
}

/// Agent and tick of all sweeps of a scenario, vehicle by vehicle, in the order of time.
pub(crate) fn present_sweeps(scenario: &Scenario) -> impl Iterator<Item = (usize, usize)> {
    let all = (0..scenario.agents.len())
        .flat_map(move |agent| (0..scenario.ticks.len()).map(move |tick| (agent, tick)));
    all.filter(move |&(agent, tick)| scenario.is_present(agent, tick))
}

/// Features and pose of a sweep; `None` for a sweep without cells.
fn described(
    scenario: &Scenario,
    agent: usize,
    tick: usize,
    localizer: &Localizer,
) -> Result<Option<DescribedSweep>, Error> {
    let frame = scenario.load(agent, tick, &LoadOptions::default())?;
    let Some(pose) = frame.world_from_lidar else {
        let path = scenario.points_path(agent, tick, None)?;
        return Err(ReadError::malformed(&path, "there is no pose for this sweep").into());
    };
    let features = localizer.sweep_features(&frame.points, &mut stopwatch())?;
    Ok(features.map(|descriptor| DescribedSweep {
        descriptor,
        world_from_sensor: pose.isometry(),
    }))
}
