//! `status.json` in the folder of a run: its state, written during the run and for the last time at its end.

use std::fmt::Debug;
use std::fs;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant, UNIX_EPOCH};

use dataset::evaluation_protocol::EvaluationProtocol;
use protocol::NeighbourState;
use serde::{Deserialize, Serialize};
use serde_json::Value;
use support::atomic_file;
use support::bounded_file::{self, MAX_TEXT_BYTES};
use support::cli::BadInput;
use support::file_error::{AtFile, FileError};
use terminal::text_table::{Side, TextTable, number};

use crate::operate::health::{ProcessStatus, State, Usage};
use crate::operate::run_folder::plain;
use crate::score::{Progress, metrics};

/// File name.
pub const FILE: &str = "status.json";
/// Interval between two writes.
const PERIOD: Duration = Duration::from_millis(500);
/// Age of a status beyond which the run counts as unsupervised.
const STALE: Duration = Duration::from_secs(3);

/// Status of a run.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct RunStatus {
    /// Name of the run.
    pub run: String,
    /// Phase of the run.
    pub phase: Phase,
    /// Process id of the `v2vloc up` that supervises it.
    pub pid: u32,
    /// Endpoint of its router.
    pub endpoint: String,
    /// Time of writing, milliseconds on the Unix clock.
    pub written_unix_ms: u64,
    /// Time since its start, seconds.
    pub seconds: f64,
    /// Evaluation protocol of the run.
    pub protocol: Option<EvaluationProtocol>,
    /// Number of results of the ego so far: the answered ticks.
    pub frames: u64,
    /// Number of ticks that the replay has published so far.
    #[serde(default)]
    pub ticks: u64,
    /// Results per second so far.
    pub rate_hz: Option<f64>,
    /// Time since the last result, seconds.
    pub last_result_s: Option<f64>,
    /// Time from a tick to its result, milliseconds, of the last result.
    pub latency_ms: Option<f64>,
    /// Number of neighbours in the last result.
    pub fused: usize,
    /// Neighbours whose messages the ego received for the last result, and its judgement of each.
    #[serde(default)]
    pub neighbours: Vec<NeighbourState>,
    /// Number of messages dropped so far, by all processes.
    pub dropped: u64,
    /// Observed causes of lost messages so far: outages of the router, pauses of the run and of processes,
    /// ends of processes.
    #[serde(default)]
    pub causes: Vec<String>,
    /// Time since which the router is gone, seconds.
    pub router_gone_s: Option<f64>,
    /// Status of each process.
    pub processes: Vec<ProcessStatus>,
}

/// Phase of a run.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Phase {
    /// The run goes on.
    Running,
    /// Its processes are being ended.
    Ending,
    /// The run is over.
    Over,
    /// The supervisor has ended without a final status.
    Lost,
    /// A signal has stopped the supervisor (Ctrl-Z); its fleet goes on.
    Suspended,
}

impl RunStatus {
    /// Reads the status in the folder of a run, and checks whether its supervisor still runs.
    ///
    /// # Errors
    /// [`FileError`] when the file cannot be read, or is no status.
    pub fn read(folder: &Path) -> Result<Self, FileError> {
        let path = folder.join(FILE);
        let text = bounded_file::read_text(&path, MAX_TEXT_BYTES).map_err(|error| {
            let hint = match is_stepped(folder) {
                true => "a run in simulation time has no processes; `v2vloc report` shows it",
                false => "is it the folder of a run that `v2vloc up` has started?",
            };
            FileError::new(&path, format_args!("{error}; {hint}"))
        })?;
        let mut status: Self = serde_json::from_str(&text).at(&path)?;
        let supervisor = Usage::of(status.pid);
        // Another program may have the number of a supervisor that has ended, so the age counts too.
        if status.phase != Phase::Over && (supervisor.is_none() || status.age() > STALE) {
            status.phase = match supervisor {
                Some(usage) if usage.is_stopped => Phase::Suspended,
                _ => Phase::Lost,
            };
        }
        Ok(status)
    }

    /// Folder of a run that is named by its path or by its name in `runs`; not named: the newest.
    ///
    /// # Errors
    /// [`BadInput`] when no run has this name or path, or when none is named and there is none.
    pub fn folder(named: Option<PathBuf>, runs: &Path) -> Result<PathBuf, BadInput> {
        match named {
            Some(run) if run.is_dir() => Ok(run),
            Some(name) if runs.join(&name).is_dir() => Ok(runs.join(name)),
            Some(name) => {
                let (name, runs) = (name.display(), runs.display());
                let problem = format!("there is no run {name}, neither here nor in {runs}");
                Err(BadInput::new(problem))
            }
            None => Self::newest(runs),
        }
    }

    /// Folder of the run in `runs` with the newest status.
    ///
    /// # Errors
    /// [`BadInput`] when no run has one.
    pub fn newest(runs: &Path) -> Result<PathBuf, BadInput> {
        let entries = fs::read_dir(runs).into_iter().flatten().flatten();
        let folders = entries.filter_map(|entry| {
            let file = fs::metadata(entry.path().join(FILE)).ok()?;
            Some((file.modified().ok()?, entry.path()))
        });
        let newest = folders.max_by_key(|(written, _)| *written);
        let problem = || BadInput::new(format!("there is no run in {}", runs.display()));
        newest.map(|(_, folder)| folder).ok_or_else(problem)
    }

    /// Problems as text: of processes during the run; of failed or crashed ones when it is over.
    pub fn troubles(&self) -> Vec<String> {
        let all = self.processes.iter();
        let sick = all.filter(|process| self.is_sick(process));
        let sick = sick.map(|process| {
            let why = why(process).map_or(String::new(), |why| format!(": {why}"));
            format!("{} is {}{why}", process.name, name_of(&process.state))
        });
        let age_s = self.age().as_secs_f64();
        let run = match (self.phase, self.router_gone_s) {
            (Phase::Lost, _) => Some("the supervisor has ended".to_owned()),
            (Phase::Suspended, _) => Some(format!("the run is suspended for {age_s:.0} s")),
            (Phase::Running, Some(seconds)) => Some(format!("router gone for {seconds:.1} s")),
            _ => None,
        };
        run.into_iter().chain(sick).collect()
    }

    fn is_sick(&self, process: &ProcessStatus) -> bool {
        let is_well = match self.phase {
            Phase::Running => {
                matches!(process.state, State::Ready | State::Ended) && process.problems.is_empty()
            }
            Phase::Ending | Phase::Over => process.state != State::Down,
            // States of processes are from before that, so the run alone is named.
            Phase::Lost | Phase::Suspended => true,
        };
        !is_well || process.failure.is_some()
    }

    /// Time since it was written.
    fn age(&self) -> Duration {
        Duration::from_millis(unix_ms().saturating_sub(self.written_unix_ms))
    }

    /// The status as text for a terminal.
    pub fn table(&self) -> String {
        let mut text = format!(
            "{} {} for {:.0} s at {}: answered {}/{}, {} Hz, latency {} ms, {} fused, {} dropped\n",
            self.run,
            name_of(&self.phase),
            self.seconds,
            self.endpoint,
            self.frames,
            self.ticks,
            number(self.rate_hz, 1),
            number(self.latency_ms, 0),
            self.fused,
            self.dropped
        );
        if !self.causes.is_empty() {
            text += &format!("observed: {}\n", self.causes.join(", "));
        }
        text += &self.processes_table().to_string();
        if !self.neighbours.is_empty() {
            text += &self.neighbours_table().to_string();
        }
        text
    }

    fn processes_table(&self) -> TextTable {
        let numbers = ["pid", "up s", "restarts", "silent s", "MiB", "fds"];
        let note = "problem, last crash or failure";
        let mut table = table_with_note(&["process", "state"], &numbers, note);
        for process in &self.processes {
            table.row([
                process.name.clone(),
                name_of(&process.state),
                number(process.pid.map(f64::from), 0),
                format!("{:.0}", process.up_s),
                process.restarts.to_string(),
                number(process.silent_s, 1),
                number(process.usage.resident_mib, 0),
                number(process.usage.descriptors.map(|count| count as f64), 0),
                why(process).unwrap_or_default(),
            ]);
        }
        table
    }

    fn neighbours_table(&self) -> TextTable {
        let numbers = ["clock ms", "capture ms", "trust"];
        let mut table = table_with_note(&["neighbour"], &numbers, "left out because");
        for neighbour in &self.neighbours {
            table.row([
                neighbour.cav.to_string(),
                number(neighbour.clock_offset_s.map(|seconds| seconds * 1e3), 1),
                number(neighbour.capture_offset_s.map(|seconds| seconds * 1e3), 1),
                number(neighbour.trust, 2),
                plain(neighbour.misbehaviour),
            ]);
        }
        table
    }
}

/// True if the metrics in a folder are of a run in simulation time.
fn is_stepped(folder: &Path) -> bool {
    let text = bounded_file::read_text(&folder.join(metrics::FILE), MAX_TEXT_BYTES);
    let metrics = text.ok().and_then(|text| serde_json::from_str(&text).ok());
    metrics.is_some_and(|of: Value| of["clock"] == "stepped")
}

/// A table with columns of texts, then of numbers, then one of text.
pub(super) fn table_with_note(texts: &[&str], numbers: &[&str], note: &str) -> TextTable {
    let texts = texts.iter().map(|name| (*name, Side::Left));
    let numbers = numbers.iter().map(|name| (*name, Side::Right));
    TextTable::new(texts.chain(numbers).chain([(note, Side::Left)]))
}

/// Failure of a process, its problems, or its last crash.
fn why(process: &ProcessStatus) -> Option<String> {
    let problems = (!process.problems.is_empty()).then(|| process.problems.join("; "));
    let failure = process.failure.clone().or(problems);
    failure.or_else(|| process.last_exit.clone())
}

/// Name of a state or phase as in the file: each is one word.
pub(super) fn name_of(value: &impl Debug) -> String {
    format!("{value:?}").to_lowercase()
}

/// Writes the status of a run periodically.
#[derive(Debug)]
pub(crate) struct StatusWriter {
    path: PathBuf,
    run: String,
    endpoint: String,
    protocol: Option<EvaluationProtocol>,
    began: Instant,
    written: Option<Instant>,
    /// A full disk is reported once.
    has_warned: bool,
}

impl StatusWriter {
    /// For the run in `folder`, with its router at `endpoint`, judged by `protocol`.
    pub(crate) fn new(
        folder: &Path,
        run: &str,
        endpoint: &str,
        protocol: Option<EvaluationProtocol>,
    ) -> Self {
        Self {
            path: folder.join(FILE),
            run: run.to_owned(),
            endpoint: endpoint.to_owned(),
            protocol,
            began: Instant::now(),
            written: None,
            has_warned: false,
        }
    }

    /// Writes the status if it is due, or if `phase` has changed.
    pub(crate) fn write(
        &mut self,
        phase: Phase,
        progress: &Progress,
        (causes, router_gone_s): (Vec<String>, Option<f64>),
        processes: impl FnOnce(Instant) -> Vec<ProcessStatus>,
    ) {
        let now = Instant::now();
        let is_recent = self
            .written
            .is_some_and(|last| now.duration_since(last) < PERIOD);
        if phase == Phase::Running && is_recent {
            return;
        }
        self.written = Some(now);
        let status = RunStatus {
            run: self.run.clone(),
            phase,
            pid: std::process::id(),
            endpoint: self.endpoint.clone(),
            written_unix_ms: unix_ms(),
            seconds: now.duration_since(self.began).as_secs_f64(),
            protocol: self.protocol.clone(),
            frames: progress.frames,
            ticks: progress.ticks,
            rate_hz: progress.rate_hz(),
            last_result_s: progress
                .span
                .map(|(_, last)| now.saturating_duration_since(last).as_secs_f64()),
            latency_ms: progress.latency_ms,
            fused: progress.fused,
            neighbours: progress.neighbours.clone(),
            dropped: progress.dropped,
            causes,
            router_gone_s,
            processes: processes(now),
        };
        let json = serde_json::to_string_pretty(&status).unwrap_or_default();
        // Not synced to the disk: it is replaced twice a second.
        match atomic_file::write_volatile(&self.path, json) {
            Ok(()) => self.has_warned = false,
            Err(error) if !self.has_warned => {
                self.has_warned = true;
                let path = self.path.display();
                tracing::warn!("{path}: {error}; `v2vloc status` will show an old state");
            }
            Err(_) => {}
        }
    }
}

fn unix_ms() -> u64 {
    u64::try_from(UNIX_EPOCH.elapsed().unwrap_or_default().as_millis()).unwrap_or(u64::MAX)
}

#[cfg(test)]
mod tests {
    use std::process::Command;

    use super::*;

    fn observed() -> (Vec<String>, Option<f64>) {
        (vec!["router gone for 4.0 s".into()], None)
    }

    fn process(state: State) -> ProcessStatus {
        ProcessStatus {
            name: "agent-4288".into(),
            state,
            pid: Some(77),
            up_s: 12.3,
            restarts: 2,
            last_exit: Some("was ended by signal 9".into()),
            failure: (state == State::Failing).then(|| "recording cut".into()),
            problems: vec![],
            silent_s: Some(0.2),
            usage: Usage {
                resident_mib: Some(150.0),
                threads: Some(20),
                descriptors: Some(31),
                is_stopped: false,
            },
        }
    }

    #[test]
    fn a_status_reads_back_and_an_ended_supervisor_is_detected() {
        let folder = tempfile::tempdir().unwrap();
        let run = folder.path().join("test");
        fs::create_dir(&run).unwrap();
        let error = RunStatus::newest(folder.path()).unwrap_err();
        assert!(error.to_string().starts_with("there is no run in /"));
        assert!(
            RunStatus::read(&run)
                .unwrap_err()
                .to_string()
                .contains("status.json")
        );
        fs::write(run.join(metrics::FILE), r#"{"clock": "stepped"}"#).unwrap();
        let stepped = RunStatus::read(&run).unwrap_err().to_string();
        assert!(stepped.contains("`v2vloc report` shows it"), "{stepped}");
        let mut writer = StatusWriter::new(&run, "test", "tcp/127.0.0.1:7447", None);
        let attacker = NeighbourState {
            cav: protocol::CavId::new("4279").unwrap(),
            trust: Some(0.03),
            misbehaviour: Some(protocol::MisbehaviourReason::GhostObjects),
            clock_offset_s: Some(0.0125),
            capture_offset_s: Some(0.3),
        };
        let progress = Progress {
            frames: 7,
            ticks: 9,
            neighbours: vec![attacker],
            ..Progress::default()
        };
        writer.write(Phase::Running, &progress, observed(), |_| {
            vec![process(State::Ready)]
        });
        // Not due yet.
        writer.write(Phase::Running, &Progress::default(), observed(), |_| {
            Vec::new()
        });
        let status = RunStatus::read(&RunStatus::newest(folder.path()).unwrap()).unwrap();
        assert_eq!(
            (status.phase, status.frames, status.processes.len()),
            (Phase::Running, 7, 1)
        );
        assert!(status.troubles().is_empty());
        let table = status.table();
        assert!(
            table.starts_with("test running for 0 s at tcp/127.0.0.1:7447: answered 7/9, - Hz"),
            "{table}"
        );
        assert!(
            table.contains("\nobserved: router gone for 4.0 s\n"),
            "{table}"
        );
        assert!(
            table.ends_with("4279           12.5       300.0   0.03  ghost_objects\n"),
            "{table}"
        );
        assert!(
            table.contains("agent-4288") && table.contains("was ended by signal 9"),
            "{table}"
        );

        let ended = RunStatus {
            pid: u32::MAX,
            ..status.clone()
        };
        fs::write(run.join(FILE), serde_json::to_string(&ended).unwrap()).unwrap();
        let found = RunStatus::read(&run).unwrap();
        assert!(found.phase == Phase::Lost && !found.troubles().is_empty());
        let gone = RunStatus {
            router_gone_s: Some(2.5),
            ..status.clone()
        };
        assert_eq!(gone.troubles(), ["router gone for 2.5 s"]);
        let mut stopped = Command::new("sleep").arg("60").spawn().unwrap();
        let suspended = RunStatus {
            pid: stopped.id(),
            written_unix_ms: unix_ms() - 20_000,
            ..status.clone()
        };
        fs::write(run.join(FILE), serde_json::to_string(&suspended).unwrap()).unwrap();
        assert_eq!(RunStatus::read(&run).unwrap().phase, Phase::Lost);
        let pid = stopped.id().to_string();
        let sent = Command::new("kill").args(["-STOP", &pid]).status();
        assert!(sent.unwrap().success());
        let deadline = Instant::now() + Duration::from_secs(10);
        while RunStatus::read(&run).unwrap().phase != Phase::Suspended {
            assert!(Instant::now() < deadline);
        }
        assert_eq!(
            RunStatus::read(&run).unwrap().troubles()[0],
            "the run is suspended for 20 s"
        );
        stopped.kill().unwrap();
        stopped.wait().unwrap();
        fs::write(run.join(FILE), "{").unwrap();
        assert!(RunStatus::read(&run).is_err());
    }

    #[test]
    fn who_is_not_ready_makes_a_run_unwell() {
        let folder = tempfile::tempdir().unwrap();
        for (state, is_well) in [
            (State::Ready, true),
            (State::Ended, true),
            (State::Starting, false),
            (State::Failing, false),
            (State::Silent, false),
            (State::Crashed, false),
            (State::Down, false),
        ] {
            let mut writer = StatusWriter::new(folder.path(), "test", "tcp/127.0.0.1:7447", None);
            writer.write(Phase::Running, &Progress::default(), observed(), |_| {
                vec![process(state)]
            });
            assert_eq!(
                RunStatus::read(folder.path())
                    .unwrap()
                    .troubles()
                    .is_empty(),
                is_well,
                "{state:?}"
            );
        }
    }

    #[test]
    fn a_disk_that_refuses_ends_nothing() {
        let mut writer =
            StatusWriter::new(Path::new("/nowhere"), "test", "tcp/127.0.0.1:7447", None);
        writer.write(Phase::Running, &Progress::default(), observed(), |_| {
            Vec::new()
        });
        assert!(writer.has_warned);
    }
}
