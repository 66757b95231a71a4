//! Cached poses: refuses tables that were computed from other data than those to which they are applied.

use dataset::Scenario;
use localization::pose_source::{PoseSourceConfig, PoseTable};
use support::file_digests::FileDigests;
use support::file_error::Result;

/// Refuses a table of other data; `scenarios` have all their agents and ticks.
///
/// # Errors
/// An error with the file and both digests, or when it cannot be read.
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
        let sha256 = || dataset::scenario_sha256(scenario, digests);
        table.check_data(&scenario.name, sha256)
    })
}
