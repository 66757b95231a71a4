//! Experiments from files: paths, networks and checks.

use std::path::Path;

use anyhow::{Result, anyhow};
use link::LinkConfig;
use support::config_file;
use support::file_error::FileError;

use super::check;
use super::spec::{Experiment, Table};

impl Experiment {
    /// Reads and checks an experiment.
    ///
    /// # Errors
    /// [`FileError`] names the file and the field.
    pub fn read(path: &Path) -> Result<Self, FileError> {
        let mut experiment: Self = config_file::read(path)?;
        if experiment.tables.is_empty() {
            experiment.resolve(path.parent().unwrap_or(Path::new(".")));
        }
        experiment
            .find_networks()
            .and_then(|()| check::check(&experiment))
            .map_err(|problem| FileError::new(path, problem))?;
        Ok(experiment)
    }

    fn resolve(&mut self, folder: &Path) {
        for place in std::iter::once(&mut self.dataset).chain(&mut self.weights) {
            *place = folder.join(&place);
        }
        // A name that is no preset is the path of a file.
        if let Some(link) = &mut self.link
            && LinkConfig::preset(link).is_none()
        {
            *link = folder.join(&link).to_string_lossy().into_owned();
        }
    }

    fn find_networks(&mut self) -> Result<()> {
        let mut all = vec![&mut self.poses];
        for Table { rows, columns, .. } in &mut self.tables {
            all.extend(rows.iter_mut().filter_map(|row| row.poses.as_mut()));
            let columns = columns.iter_mut();
            all.extend(columns.filter_map(|column| column.poses.as_mut()));
        }
        for poses in all {
            let found = std::mem::take(poses).with_networks();
            *poses = found.map_err(|error| anyhow!("poses: {error}"))?;
        }
        Ok(())
    }
}
