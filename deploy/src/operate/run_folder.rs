//! `runs/<name>/`: files of a run.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::time::UNIX_EPOCH;
use std::{fs, io};

use protocol::RunId;
use serde::Serialize;
use support::atomic_file;
use support::cli::BadInput;
use support::csv_file::CsvText;
use support::file_error::{AtFile, FileError, check_folder};
use time::UtcDateTime;

use crate::score::{FrameRecord, ms_between};

/// Reason why a run folder cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum RunFolderError {
    /// A run of that name has a folder already.
    #[error("{} exists already: choose another --name, or remove it", .0.display())]
    Taken(PathBuf),
    /// A file has the name of the folder of the run folders.
    #[error("--runs {0}")]
    NoFolder(#[source] BadInput),
    /// A file or folder cannot be written.
    #[error("cannot write {0}")]
    Write(#[source] FileError),
}

/// The result of writing a file or folder at a path.
fn written<T>(result: io::Result<T>, path: &Path) -> Result<T, RunFolderError> {
    result.at(path).map_err(RunFolderError::Write)
}

/// The recording of a run.
pub const RECORDING: &str = "recording.mcap";
/// Arrival times of the sweeps at the ego's agent.
pub const SWEEP_LOG: &str = "sweeps.csv";
/// Checkpoint of the replay, from which a restarted one resumes.
pub const CHECKPOINT: &str = "replay.json";

/// The folder of one run.
#[derive(Debug, Clone)]
pub struct RunFolder {
    path: PathBuf,
}

impl RunFolder {
    /// Creates `<runs>/<name>` and `log` in it.
    ///
    /// # Errors
    /// [`RunFolderError`] when it is there already or cannot be created.
    pub fn create(runs: &Path, name: &RunId) -> Result<Self, RunFolderError> {
        check_folder(runs).map_err(|error| RunFolderError::NoFolder(BadInput::of(error)))?;
        let runs = std::path::absolute(runs).unwrap_or_else(|_| runs.into());
        let path = runs.join(name.as_str());
        written(atomic_file::create_folder(&runs), &runs)?;
        // One call that fails if the folder exists, so that two runs never share a folder.
        match fs::create_dir(&path) {
            Err(error) if error.kind() == io::ErrorKind::AlreadyExists => {
                return Err(RunFolderError::Taken(path));
            }
            created => written(created, &path)?,
        }
        let log = path.join("log");
        written(fs::create_dir(&log), &log)?;
        written(atomic_file::sync_name(&path), &path)?;
        Ok(Self { path })
    }

    /// Removes it with all its files: for a run that was refused before it began, so that its name is free again.
    pub fn remove(self) {
        if let Err(error) = fs::remove_dir_all(&self.path) {
            let folder = self.path.display();
            tracing::warn!(
                "cannot remove {folder}, the folder of a run that did not begin: {error}"
            );
        }
    }

    /// Path of the folder.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Folder of the processes' logs.
    pub fn log_dir(&self) -> PathBuf {
        self.path.join("log")
    }

    /// Log of a process.
    pub fn log_of(&self, process: &str) -> PathBuf {
        self.log_dir().join(format!("{process}.log"))
    }

    /// Path of a file in the folder.
    pub fn file(&self, name: &str) -> PathBuf {
        self.path.join(name)
    }

    /// Writes a text file.
    ///
    /// # Errors
    /// [`RunFolderError::Write`].
    pub fn write(&self, name: &str, text: &str) -> Result<(), RunFolderError> {
        let path = self.file(name);
        written(atomic_file::write(&path, text), &path)
    }

    /// Writes the configuration of a process to `config/<process>.yaml`; returns its path.
    ///
    /// # Errors
    /// [`RunFolderError::Write`].
    pub fn write_config(
        &self,
        process: &str,
        config: &impl Serialize,
    ) -> Result<PathBuf, RunFolderError> {
        let name = format!("config/{process}.yaml");
        let path = self.file(&name);
        let text = serde_saphyr::to_string(config)
            .map_err(|error| io::Error::other(error.to_string()))
            .and_then(|text| fs::create_dir_all(self.file("config")).map(|()| text));
        let text = written(text, &path)?;
        self.write(&name, &text)?;
        Ok(path)
    }

    /// Writes `value` as indented JSON.
    ///
    /// # Errors
    /// [`RunFolderError::Write`].
    pub fn write_json(&self, name: &str, value: &impl Serialize) -> Result<(), RunFolderError> {
        let text = serde_json::to_string_pretty(value).map_err(io::Error::from);
        let text = written(text, &self.file(name))?;
        self.write(name, &(text + "\n"))
    }
}

/// `frames.csv`: a header line, then a line per tick, answered or not. `arrivals` holds the arrival time of each sweep at
/// the ego's agent, by capture time, Unix nanoseconds. With the scenario of each tick, that is the first column.
pub fn frames_csv(
    records: &[FrameRecord],
    arrivals: &BTreeMap<u64, u64>,
    scenarios: Option<&[String]>,
) -> String {
    let scenario = scenarios.map(|_| "scenario");
    let names = COLUMNS.iter().map(|(name, _)| *name);
    let mut text = CsvText::headless();
    text.row(scenario.into_iter().chain(names));
    for (place, record) in records.iter().enumerate() {
        let scenario = scenarios.and_then(|all| all.get(place)).cloned();
        let arrival = arrivals.get(&record.capture_nanos);
        let times = record.stamps.began_nanos.zip(arrival);
        let swept_ms = times.map(|(began, arrival)| ms_between(began, *arrival));
        let fields = COLUMNS.iter().map(|(_, field)| field(record, swept_ms));
        text.row(scenario.into_iter().chain(fields));
    }
    text.finish()
}

/// Name of a column, and its value for a tick whose sweep arrived so many milliseconds after the tick.
type FrameColumn = (&'static str, fn(&FrameRecord, Option<f64>) -> String);

const COLUMNS: [FrameColumn; 28] = [
    ("tick", |of, _| of.tick.to_string()),
    ("agent_frame", |of, _| plain(of.agent_frame)),
    ("capture_nanos", |of, _| of.capture_nanos.to_string()),
    ("latency_ms", |of, _| fixed(of.latency_ms, 4)),
    ("detected", |of, _| of.detected.to_string()),
    ("truth", |of, _| of.truth.to_string()),
    ("found", |of, _| of.found.to_string()),
    ("fused", |of, _| of.fused.to_string()),
    ("skipped", |of, _| of.skipped.to_string()),
    ("oldest_ms", |of, _| fixed(of.oldest_ms, 4)),
    ("stale", |of, _| of.stale.to_string()),
    ("payload_bytes", |of, _| of.payload_bytes.to_string()),
    ("wire_bytes", |of, _| of.wire_bytes.to_string()),
    ("ego_error_m", |of, _| fixed(of.ego_error_m, 4)),
    ("ego_error_deg", |of, _| fixed(of.ego_error_deg, 4)),
    ("swept_ms", |_, swept_ms| fixed(swept_ms, 4)),
    ("posed_ms", |of, _| fixed(of.stamps.posed_ms, 4)),
    ("published_ms", |of, _| fixed(of.stamps.published_ms, 4)),
    ("arrived_ms", |of, _| fixed(of.stamps.arrived_ms, 4)),
    ("decided_ms", |of, _| fixed(of.stamps.decided_ms, 4)),
    ("fused_ms", |of, _| fixed(of.stamps.fused_ms, 4)),
    ("detected_ms", |of, _| fixed(of.stamps.detected_ms, 4)),
    ("answered", |of, _| u8::from(of.is_answered()).to_string()),
    ("tick_unix_nanos", |of, _| plain(of.stamps.began_nanos)),
    ("streamed_tick", |of, _| {
        plain(of.streamed.map(|of| of.tick))
    }),
    ("streamed_age_ms", |of, _| {
        fixed(of.streamed.map(|of| of.age_ms), 4)
    }),
    ("streamed_detected", |of, _| {
        plain(of.streamed.map(|of| of.detected))
    }),
    ("streamed_found", |of, _| {
        plain(of.streamed.map(|of| of.found))
    }),
];

/// Field of a CSV file: a number with this many decimals, empty if it is unknown.
pub fn fixed(value: Option<f64>, digits: usize) -> String {
    value.map_or(String::new(), |value| format!("{value:.digits$}"))
}

/// Field of a CSV file: a value as it prints, empty if it is unknown.
pub fn plain(value: Option<impl ToString>) -> String {
    value.map_or(String::new(), |value| value.to_string())
}

/// Name for an unnamed run: `prefix` and the time, UTC, for example `up-20260131-235959`.
///
/// # Panics
/// Never with a `prefix` of an identifier's characters, at most 16.
pub fn name_of_now(prefix: &str) -> RunId {
    let seconds = UNIX_EPOCH.elapsed().unwrap_or_default().as_secs();
    let name = format!("{prefix}-{}", time_stamp(seconds));
    RunId::new(&name).expect("a prefix and digits make an identifier")
}

/// Seconds of the Unix clock as `YYYYMMDD-HHMMSS`, UTC.
fn time_stamp(unix_secs: u64) -> String {
    let time = UtcDateTime::from_unix_timestamp(unix_secs.cast_signed());
    let time = time.unwrap_or(UtcDateTime::UNIX_EPOCH);
    let (year, month, day) = time.to_calendar_date();
    let (hour, minute, second) = time.as_hms();
    let month = u8::from(month);
    format!("{year:04}{month:02}{day:02}-{hour:02}{minute:02}{second:02}")
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::score::{StageStamps, StreamedResult};

    #[test]
    fn two_runs_never_share_a_folder() {
        let runs = tempfile::tempdir().unwrap();
        let name = RunId::new("r1").unwrap();
        let folder = RunFolder::create(&runs.path().join("deeper"), &name).unwrap();
        assert!(folder.log_dir().is_dir() && folder.path().is_absolute());
        let error = RunFolder::create(&runs.path().join("deeper"), &name)
            .unwrap_err()
            .to_string();
        assert!(error.contains("r1 exists already"), "{error}");
        folder.remove();
        RunFolder::create(&runs.path().join("deeper"), &name).unwrap();
    }

    #[test]
    fn a_file_in_place_of_the_folder_of_runs_is_bad_input() {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("base.yaml");
        fs::write(&file, "").unwrap();
        let error = RunFolder::create(&file, &RunId::new("r1").unwrap()).unwrap_err();
        assert_eq!(
            error.to_string(),
            format!("--runs {}: is a file, must be a folder", file.display())
        );
        let source = std::error::Error::source(&error).unwrap();
        assert!(source.is::<BadInput>());
    }

    #[test]
    fn every_line_of_the_table_has_every_column() {
        let record = FrameRecord {
            tick: 3,
            agent_frame: Some(2),
            capture_nanos: 300_000_000,
            latency_ms: Some(81.25),
            stamps: StageStamps {
                began_nanos: Some(1_000_000_000),
                posed_ms: Some(40.5),
                detected_ms: Some(81.25),
                ..StageStamps::default()
            },
            detected: 20,
            truth: 22,
            found: 18,
            fused: 1,
            skipped: 0,
            oldest_ms: Some(100.0),
            stale: 1,
            payload_bytes: 1000,
            wire_bytes: 1300,
            ego_error_m: Some(0.25),
            ego_error_deg: None,
            streamed: Some(StreamedResult {
                tick: 1,
                age_ms: 200.5,
                detected: 15,
                found: 12,
            }),
        };
        let unanswered = FrameRecord {
            agent_frame: None,
            latency_ms: None,
            streamed: None,
            ..record.clone()
        };
        let text = frames_csv(
            &[record, unanswered],
            &BTreeMap::from([(300_000_000, 1_002_500_000)]),
            None,
        );
        let lines: Vec<&str> = text.lines().collect();
        assert_eq!(
            lines[1],
            "3,2,300000000,81.2500,20,22,18,1,0,100.0000,1,1000,1300,0.2500,,2.5000,40.5000,,,,,81.2500,1,\
             1000000000,1,200.5000,15,12"
        );
        assert!(
            lines[2].starts_with("3,,300000000,,") && lines[2].ends_with(",0,1000000000,,,,"),
            "{text}"
        );
        assert!(
            lines[1..]
                .iter()
                .all(|line| line.matches(',').count() == lines[0].matches(',').count()),
            "{text}"
        );
    }

    #[test]
    fn time_stamps_are_dates() {
        // Output of `date -u -d @... +%Y%m%d-%H%M%S`.
        for (secs, text) in [
            (0, "19700101-000000"),
            (951_782_400, "20000229-000000"),
            (1_735_689_599, "20241231-235959"),
            (1_772_323_200, "20260301-000000"),
            (4_107_542_400, "21000301-000000"),
        ] {
            assert_eq!(time_stamp(secs), text);
        }
        assert!(name_of_now("up").as_str().starts_with("up-2"));
    }
}
