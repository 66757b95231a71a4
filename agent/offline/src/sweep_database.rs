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
    let datasets = folders
        .iter()
        .map(|folder| dataset::open(folder.as_ref()))
        .collect::<Result<Vec<_>, _>>()?;
    let scenarios: Vec<_> = datasets
        .iter()
        .flat_map(|dataset| &dataset.scenarios)
        .collect();
    let total = scenarios
        .iter()
        .map(|scenario| scenario.ticks.len() * scenario.agents.len())
        .sum();
    datasets
        .iter()
        .for_each(|dataset| left_out.add_files(&dataset.problems));
    let (mut sweeps, mut done) = (Vec::new(), 0);
    for scenario in scenarios {
        for agent in 0..scenario.agents.len() {
            for tick in 0..scenario.ticks.len() {
                done += 1;
                progress(done, total);
                if !scenario.is_present(agent, tick) {
                    continue;
                }
                match described(scenario, agent, tick, localizer) {
                    Ok(sweep) => sweeps.extend(sweep),
                    Err(Error::Read(error)) => {
                        left_out.add_unreadable(agent, Problem::from(&error))
                    }
                    Err(error) => return Err(error),
                }
            }
        }
    }
    let folders = || {
        folders
            .iter()
            .map(|folder| folder.as_ref().to_owned())
            .collect()
    };
    SweepDatabase::new(&sweeps).ok_or_else(|| Error::NoSweeps(folders(), left_out.reasons()))
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
