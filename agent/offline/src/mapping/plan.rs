//! Plan of a map: number of sweeps and time of each part, from the measured time of one sweep and the time there is.

use std::fs;
use std::path::Path;

use serde::{Deserialize, Serialize};
use support::atomic_file;
use support::bounded_file::{self, MAX_TEXT_BYTES};

use super::check::LEAST_CHECKED;
use crate::Error;
use crate::training::CELLS;
use support::file_error::{AtFile, FileError};

/// Largest share of the time before the check that is spent on encoding.
const ENCODING_SHARE: f64 = 0.5;
/// Largest share of the time that the check takes.
const CHECK_SHARE: f64 = 0.25;
/// Most sweeps that the head is checked on.
const MOST_CHECKED: usize = 200;
/// Most sweeps of the search for scales, the fewest, and the largest share of the time that it takes.
const MOST_SCALE_SWEEPS: usize = 30;
const LEAST_SCALE_SWEEPS: usize = 5;
const SCALES_SHARE: f64 = 0.05;
/// Most passes that a small place gets, rotated and subsampled.
const MOST_COPIES: usize = 40;
/// Number of encoded sweeps from which no copies are needed.
const ENOUGH_SWEEPS: usize = 150;
/// Largest share of the free memory that features may take.
const MEMORY_SHARE: f64 = 0.7;

/// Sweeps and times of a map.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct Plan {
    /// Number of training sweeps.
    pub(super) training: usize,
    /// Encoded copies of each.
    pub(super) copies: usize,
    /// Number of held-out sweeps that are used.
    pub(super) checked: usize,
    /// Number of training sweeps of the search for scales.
    pub(super) scale_sweeps: usize,
    /// Time of encoding, seconds.
    pub(super) encoding_s: f64,
    /// Time of the search for scales, seconds.
    pub(super) scales_s: f64,
    /// Time of the check, seconds.
    pub(super) check_s: f64,
}

impl Plan {
    /// Time after the training, seconds.
    pub(super) fn after_training_s(&self) -> f64 {
        self.scales_s + self.check_s
    }

    /// Plan for `total_s` seconds; `sweep_s`: of one sweep, to read and encode.
    pub(super) fn new(training: usize, held_out: usize, sweep_s: f64, total_s: f64) -> Self {
        let sweep_s = sweep_s.max(1e-4);
        // Each held-out sweep is localized as it is and mirrored; the localization costs as much as the encoding.
        let checked_s = 4.0 * sweep_s;
        let most_checked = (0.2 * total_s / checked_s) as usize;
        let checked = held_out.min(MOST_CHECKED).min(most_checked.max(10));
        let localized = match held_out {
            0 => 0,
            _ => checked.max(LEAST_CHECKED),
        };
        let check_s = (checked_s * localized as f64).min(CHECK_SHARE * total_s);
        // The localization costs as much as the encoding here too.
        let affordable_scales = (SCALES_SHARE * total_s / (2.0 * sweep_s)) as usize;
        let scale_sweeps = affordable_scales.clamp(LEAST_SCALE_SWEEPS, MOST_SCALE_SWEEPS);
        let scale_sweeps = scale_sweeps.min(training);
        let scales_s = 2.0 * sweep_s * scale_sweeps as f64;
        let affordable =
            ((total_s - check_s - scales_s).max(0.0) * ENCODING_SHARE / sweep_s) as usize;
        let copies = (ENOUGH_SWEEPS / training.max(1)).clamp(1, MOST_COPIES);
        // Copies take what is left once every sweep is encoded.
        let copies = copies.min((affordable / training.max(1)).max(1));
        let training = training.min(affordable.max(1));
        let encoding_s = (training * copies) as f64 * sweep_s;
        Self {
            training,
            copies,
            checked,
            scale_sweeps,
            encoding_s,
            scales_s,
            check_s,
        }
    }
}

/// A plan and the data that it is for, in the folder of the results: the measured time of a sweep differs from run to run,
/// and a resumed map needs the sweeps of the stopped one.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct StoredPlan {
    /// Identity of the drives.
    pub(super) data_sha256: String,
    /// The plan.
    pub(super) plan: Plan,
}

impl StoredPlan {
    /// Name of the file.
    const FILE: &str = "plan.json";

    pub(super) fn write(&self, out: &Path) -> Result<(), Error> {
        let path = out.join(Self::FILE);
        let text = serde_json::to_string(self).expect("a plan is numbers");
        let written = atomic_file::create_folder(out)
            .and_then(|()| atomic_file::write(&path, text.as_bytes()));
        Ok(written.at(&path)?)
    }

    /// The plan of a stopped map of drives with this identity.
    pub(super) fn read(out: &Path, data_sha256: &str) -> Result<Plan, Error> {
        let path = out.join(Self::FILE);
        let text = bounded_file::read_text(&path, MAX_TEXT_BYTES).at(&path);
        let stored = text.and_then(|text| serde_json::from_str::<Self>(&text).at(&path));
        let plan = stored.and_then(|stored| match stored.data_sha256 {
            before if before == data_sha256 => Ok(stored.plan),
            before => Err(FileError::new(
                &path,
                format_args!(
                    "the stopped map was of drives of SHA-256 {before}, these have {data_sha256}"
                ),
            )),
        });
        plan.map_err(|error| Error::Input(format!("--resume: {error}")))
    }
}

/// Bytes that the features of sweeps take: half precision, and targets.
pub(super) fn feature_bytes(sweeps: usize, channels: i64) -> u64 {
    sweeps as u64 * CELLS as u64 * (2 * channels.unsigned_abs() + 40)
}

/// Free memory and the bytes that are needed, if these are too many; `None` if it is enough, or unknown.
pub(super) fn too_little_memory(needed: u64) -> Option<u64> {
    let free = available_memory(&fs::read_to_string("/proc/meminfo").ok()?)?;
    (needed as f64 > MEMORY_SHARE * free as f64).then_some(free)
}

/// Available memory by Linux's own estimate, bytes.
fn available_memory(meminfo: &str) -> Option<u64> {
    let mut lines = meminfo.lines();
    let line = lines.find_map(|line| line.strip_prefix("MemAvailable:"))?;
    Some(line.split_ascii_whitespace().next()?.parse::<u64>().ok()? * 1024)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn all_sweeps_are_used_if_there_is_time_and_otherwise_as_many_as_fit() {
        let plan = Plan::new(600, 80, 0.1, 600.0);
        assert_eq!((plan.training, plan.copies, plan.checked), (600, 1, 80));
        assert!((plan.encoding_s - 60.0).abs() < 1e-9 && (plan.check_s - 32.0).abs() < 1e-9);
        assert_eq!(plan.scale_sweeps, 30);
        assert!((plan.after_training_s() - 38.0).abs() < 1e-9);
        let short = Plan::new(16_000, 2_000, 0.1, 600.0);
        assert!(
            short.training < 3_000 && short.encoding_s <= 300.0 && short.check_s <= 120.0,
            "{short:?}"
        );
    }

    #[test]
    fn few_sweeps_are_copied() {
        let plan = Plan::new(3, 1, 0.1, 600.0);
        assert_eq!((plan.training, plan.copies, plan.checked), (3, 40, 1));
        assert!(Plan::new(3, 1, 10.0, 60.0).copies <= 2);
        assert_eq!(
            [Plan::new(3, 1, 10.0, 60.0), Plan::new(90, 1, 0.5, 60.0)]
                .map(|plan| plan.scale_sweeps),
            [3, 5]
        );
    }

    #[test]
    fn a_plan_is_read_back_for_the_same_drives_only() {
        let folder = tempfile::tempdir().unwrap();
        let missing = StoredPlan::read(folder.path(), "12ab").unwrap_err();
        assert!(missing.to_string().contains("plan.json"), "{missing}");
        let plan = Plan::new(600, 80, 0.1, 600.0);
        let data_sha256 = "12ab".to_owned();
        let stored = StoredPlan { data_sha256, plan };
        stored.write(folder.path()).unwrap();
        assert_eq!(StoredPlan::read(folder.path(), "12ab").unwrap(), plan);
        let other = StoredPlan::read(folder.path(), "34cd").unwrap_err();
        let message = other.to_string();
        assert!(
            message.contains("of drives of SHA-256 12ab, these have 34cd"),
            "{message}"
        );
    }

    #[test]
    fn memory_is_compared_with_what_is_free() {
        assert_eq!(
            available_memory("MemTotal: 9 kB\nMemAvailable:    2048 kB\n"),
            Some(2 << 20)
        );
        assert_eq!(feature_bytes(10, 448), 10 * 400 * 936);
        assert_eq!(too_little_memory(1), None);
        assert!(too_little_memory(u64::MAX).is_some());
    }
}
