//! A fleet under faults: whatever happens to its processes, its cables and its router, it goes on and accounts for it.

use std::time::Duration;

use tests::faults::{FaultyFleet, cold_start, plan, soak};
use tests::fleet::alone;

#[test]
fn a_fleet_gets_over_a_dozen_faults() {
    let _alone = alone();
    let folder = tempfile::tempdir().unwrap();
    let mut faults = plan(7, 12);
    for fault in &mut faults {
        fault.lasts = fault.lasts.min(Duration::from_millis(500));
    }
    let report = FaultyFleet::start(folder.path())
        .suffer(&faults, |number, fault, ms| eprintln!("{number}: {fault}, as before after {ms} ms"));
    assert!(report.balances, "{}", report.differences);
    assert!(report.left_over.is_empty(), "{:?}", report.left_over);
    assert!(report.restarts > 0, "{report:?}");
    // On a machine that does other things beside, times say little; `cargo bench -p tests --bench faults` measures them.
    assert!(report.stop < Duration::from_secs(10), "{report:?}");
    assert!(report.findings.fused_again_ms.iter().all(|ms| *ms < 20_000), "{report:?}");
}

#[test]
fn a_fleet_starts_and_ends_again_and_again() {
    let _alone = alone();
    for is_secured in [false, true] {
        let folder = tempfile::tempdir().unwrap();
        let start = cold_start(folder.path(), is_secured);
        assert!(start.lost_before == 0 && start.left == 0 && start.stop < Duration::from_secs(10), "{start:?}");
    }
}

#[test]
fn a_fleet_that_lasts_opens_nothing_more_and_more() {
    let _alone = alone();
    let folder = tempfile::tempdir().unwrap();
    let soak = soak(folder.path(), Duration::from_secs(12), |_, _| {});
    assert!(soak.balances && soak.frames > 20 && soak.memory.len() == 8, "{soak:?}");
    for (name, [before, after, threads_before, threads_after]) in &soak.handles {
        assert!(*after <= before + 8 && *threads_after <= threads_before + 4, "{name}: {soak:?}");
    }
}
