//! Database of sweeps for retrieval, from drives with true poses.

use std::path::{Path, PathBuf};

use dataset::{LoadOptions, ReadError};
use localization::competitors::SweepDatabase;
use localization::pgc::{Localizer, LocalizerError, LocalizerTimes};

/// Error of building a database of sweeps.
#[derive(Debug, thiserror::Error)]
pub enum DatabaseError {
    /// A scene is not readable.
    #[error(transparent)]
    Read(#[from] ReadError),
    /// The encoder failed.
    #[error(transparent)]
    Localizer(#[from] LocalizerError),
    /// None of the sweeps has a pose and cells.
    #[error("{0:?}: no sweep with a true pose to retrieve")]
    NoSweeps(Vec<PathBuf>),
}

/// Describes every sweep of the drives; `progress` gets the number of sweeps done and of all.
///
/// # Errors
/// [`DatabaseError`] names the file.
pub fn read_database(
    folders: &[impl AsRef<Path>],
    localizer: &Localizer,
    progress: &mut dyn FnMut(usize, usize),
) -> Result<SweepDatabase, DatabaseError> {
    let datasets = folders.iter().map(|folder| dataset::open(folder.as_ref())).collect::<Result<Vec<_>, _>>()?;
    let scenarios: Vec<_> = datasets.iter().flat_map(|dataset| &dataset.scenarios).collect();
    let total = scenarios.iter().map(|scenario| scenario.ticks.len() * scenario.agents.len()).sum();
    let (mut sweeps, mut done) = (Vec::new(), 0);
    for scenario in scenarios {
        for (agent, tick) in
            (0..scenario.agents.len()).flat_map(|agent| (0..scenario.ticks.len()).map(move |tick| (agent, tick)))
        {
            done += 1;
            progress(done, total);
            if !scenario.is_present(agent, tick) {
                continue;
            }
            let frame = scenario.load(agent, tick, &LoadOptions::default())?;
            let Some(pose) = frame.world_from_lidar else { continue };
            let features = localizer.sweep_features(&frame.points, &mut LocalizerTimes::default())?;
            sweeps.extend(features.map(|features| (features, pose.isometry())));
        }
    }
    let folders = || folders.iter().map(|folder| folder.as_ref().to_owned()).collect();
    SweepDatabase::new(&sweeps).ok_or_else(|| DatabaseError::NoSweeps(folders()))
}
