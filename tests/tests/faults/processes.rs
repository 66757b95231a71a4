//! Fleet under faults: after any fault of its processes, virtual links or router, it goes on and accounts for all
//! messages.

use std::path::{Path, PathBuf};
use std::process::Command;
use std::time::Duration;

use tests::faults::{FaultyFleet, cold_start, plan, soak};
use tests::fleet::{programs, write_scenario};
use tests::locks::exclusive_lock;

#[test]
fn a_fleet_gets_over_a_dozen_faults() {
    let _exclusive = exclusive_lock();
    let folder = tempfile::tempdir().unwrap();
    let mut faults = plan(7, 12);
    for fault in &mut faults {
        fault.lasts = fault.lasts.min(Duration::from_millis(500));
    }
    let report = FaultyFleet::start(folder.path()).suffer(&faults, |number, fault, ms| {
        eprintln!("{number}: {fault}, as before after {ms} ms")
    });
    assert!(report.balances, "{}", report.discrepancies);
    assert!(report.left_over.is_empty(), "{:?}", report.left_over);
    assert!(report.restarts > 0, "{report:?}");
    // `u64::MAX` stands for never. Times are measured by `cargo bench -p tests --bench faults`.
    assert!(
        report
            .findings
            .fused_again_ms
            .iter()
            .all(|ms| *ms < u64::MAX),
        "{report:?}"
    );
}

#[test]
fn a_fleet_starts_and_ends_again_and_again() {
    let _exclusive = exclusive_lock();
    for is_secured in [false, true] {
        let folder = tempfile::tempdir().unwrap();
        let start = cold_start(folder.path(), is_secured);
        assert!(start.lost_before == 0 && start.left == 0, "{start:?}");
    }
}

#[test]
fn a_fleet_that_lasts_opens_nothing_more_and_more() {
    let _exclusive = exclusive_lock();
    let folder = tempfile::tempdir().unwrap();
    let soak = soak(folder.path(), Duration::from_secs(12), |_, _| {});
    assert!(
        soak.balances && soak.frames > 20 && soak.memory.len() == 9,
        "{soak:?}"
    );
    for (name, [before, after, threads_before, threads_after]) in &soak.handles {
        assert!(
            *after <= before + 8 && *threads_after <= threads_before + 4,
            "{name}: {soak:?}"
        );
    }
}

/// A file system of its own with room for so many KiB, until dropped.
struct SmallDisk(PathBuf);

impl SmallDisk {
    fn mount(at: &Path, kib: u32) -> Self {
        std::fs::create_dir(at).unwrap();
        let mut mount = Command::new("mount");
        mount
            .args(["-t", "tmpfs", "-o", &format!("size={kib}k"), "tmpfs"])
            .arg(at);
        assert!(
            mount.status().unwrap().success(),
            "{} cannot be mounted",
            at.display()
        );
        Self(at.to_path_buf())
    }
}

impl Drop for SmallDisk {
    fn drop(&mut self) {
        let _ = Command::new("umount").arg("--lazy").arg(&self.0).status();
    }
}

#[test]
#[ignore = "needs to mount a file system"]
fn a_full_disk_ends_no_run_and_takes_no_result_with_it() {
    let _exclusive = exclusive_lock();
    let folder = tempfile::tempdir().unwrap();
    let disk = SmallDisk::mount(&folder.path().join("runs"), 24);
    let scenario = write_scenario(folder.path(), 60, "rate: 2", "");
    let run = Command::new(programs().join("v2vloc"))
        .arg("up")
        .arg(&scenario)
        .arg("--runs")
        .arg(&disk.0)
        .output();
    let output = run.unwrap();
    let [stdout, stderr] =
        [&output.stdout, &output.stderr].map(|bytes| String::from_utf8_lossy(bytes));
    assert_eq!(output.status.code(), Some(3), "{stdout}{stderr}");
    assert!(
        stdout.contains("every message is accounted for"),
        "{stdout}{stderr}"
    );
    assert!(
        stdout.contains("unwritten cannot write") && stdout.contains("metrics.json: No space left"),
        "{stdout}{stderr}"
    );
    let answered = stdout.lines().nth(1).and_then(|row| {
        row.split_whitespace()
            .nth(2)?
            .split_once('/')?
            .0
            .parse()
            .ok()
    });
    assert!(
        answered.is_some_and(|answered: u32| answered > 40),
        "{stdout}{stderr}"
    );
    assert_eq!(
        stderr.matches("detections.jsonl waits").count(),
        1,
        "reported once: {stderr}"
    );
    assert!(
        !disk.0.join("test/metrics.json").exists(),
        "half a file is worse than none"
    );
}
