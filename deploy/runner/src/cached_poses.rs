//! Cached poses: refuses tables without a scenario to which they are applied, or computed from other data.

use dataset::Scenario;
use localization::pose_source::{PoseSourceConfig, PoseTable};
use support::file_digests::FileDigests;
use support::file_error::{FileError, Result};

/// Refuses a table without one of the scenarios, or of other data; `scenarios` have all their agents and ticks.
///
/// # Errors
/// An error with the file and the scenario, or both digests, or when it cannot be read.
pub(crate) fn check<'a>(
    pose: &PoseSourceConfig,
    mut scenarios: impl Iterator<Item = &'a Scenario>,
    digests: &FileDigests,
) -> Result<()> {
    let PoseSourceConfig::Cached(cached) = pose else {
        return Ok(());
    };
    let table = PoseTable::read(&cached.file)?;
    scenarios.try_for_each(|scenario| {
        let name = &scenario.name;
        // A scenario without a frame has no poses either.
        if table.origin(name).is_none() && !scenario.ticks.is_empty() {
            let problem = format!("no poses of scenario {name} in it");
            return Err(FileError::new(&cached.file, problem));
        }
        let sha256 = || dataset::scenario_sha256(scenario, digests);
        table.check_data(name, sha256)
    })
}

#[cfg(test)]
mod tests {
    use std::fs;

    use localization::pose_source::CachedPoseConfig;

    use super::*;

    #[test]
    fn a_table_without_the_scenario_is_refused() {
        let folder = tempfile::tempdir().unwrap();
        let agent = folder.path().join("town/1");
        fs::create_dir_all(&agent).unwrap();
        let pose = "lidar_pose: [0, 0, 2, 0, 0, 0]\nvehicles: {}\n";
        fs::write(agent.join("000000.yaml"), pose).unwrap();
        fs::write(agent.join("000000.pcd"), "").unwrap();
        let mut scenario = dataset::open(folder.path()).unwrap().scenarios.remove(0);
        let file = folder.path().join("poses.csv");
        PoseTable::append(&file, "elsewhere", "", &[]).unwrap();
        let pose = PoseSourceConfig::Cached(CachedPoseConfig {
            file,
            scenario: None,
        });
        let of = |scenario: &Scenario| {
            check(&pose, [scenario].into_iter(), &FileDigests::default())
                .map_err(|error| error.to_string())
        };
        let refused = of(&scenario).unwrap_err();
        assert!(
            refused.ends_with("poses.csv: no poses of scenario town in it"),
            "{refused}"
        );
        scenario.ticks.clear();
        assert_eq!(of(&scenario), Ok(()));
    }
}
