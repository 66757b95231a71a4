//! Keeps the processes of a run alive: starts them, logs them, starts the fallen again, ends them all in time.
//!
//! Every process reads its standard input as a lifeline: the supervisor holds the other end and never writes, so that
//! the death of the supervisor, however sudden, ends the fleet.

use std::ffi::OsString;
use std::fs::{File, OpenOptions};
use std::os::unix::process::ExitStatusExt;
use std::path::{Path, PathBuf};
use std::process::{ExitStatus, Stdio};
use std::sync::mpsc::Sender;
use std::time::{Duration, Instant};

use rustix::process::{Pid, Signal, kill_process};
use tokio::process::{Child, Command};
use tokio::runtime::Runtime;
use tokio::sync::watch;
use tokio::task::JoinHandle;

/// Exit code of our programs for bad usage or input: starting again cannot help.
const BAD_INPUT: i32 = 2;
/// Exit code of our programs when all was done but data were lost.
const DATA_LOST: i32 = 3;
/// A process that has lived this long has recovered; its next fall is a first one again.
const RECOVERED: Duration = Duration::from_secs(10);
/// First pause before a restart; it doubles up to [`LONGEST_PAUSE`].
const FIRST_PAUSE: Duration = Duration::from_millis(200);
/// Longest pause before a restart.
const LONGEST_PAUSE: Duration = Duration::from_secs(5);

/// One process of the fleet.
#[derive(Debug, Clone)]
pub struct ProcessSpec {
    /// Name in messages and of its log.
    pub name: String,
    /// The executable.
    pub program: PathBuf,
    /// Its arguments.
    pub args: Vec<OsString>,
    /// What its end means.
    pub life: Life,
}

/// What the end of a process means.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Life {
    /// When it fails, it is started again.
    Service,
    /// It has one job, which cannot be taken up in the middle; when it fails, it stays down.
    Task,
    /// Like a task, but the run goes on without it.
    Optional,
}

/// What happened to a process.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ProcessEvent {
    /// Name of the process.
    pub name: String,
    /// What happened.
    pub what: Happening,
}

/// What happened to a process.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Happening {
    /// It runs.
    Started {
        /// Its process id.
        pid: u32,
    },
    /// It fell and will be started again after a pause.
    Fell {
        /// How it ended, in words.
        how: String,
        /// The pause.
        again_after: Duration,
    },
    /// It fell and stays down.
    GaveUp {
        /// How it ended, in words, with the last line of its log.
        how: String,
        /// Whether the run can go on without it.
        is_optional: bool,
    },
    /// It ended by itself, as it should.
    Done {
        /// It says that data were lost.
        data_lost: bool,
    },
}

/// Why a process could not be started at all.
#[derive(Debug, thiserror::Error)]
pub enum SuperviseError {
    /// The executable is not there.
    #[error("{} is missing: build it (cargo build --release), it belongs beside v2vloc", .0.display())]
    NoProgram(PathBuf),
    /// The log cannot be written.
    #[error("cannot write the log {}: {source}", path.display())]
    Log {
        /// The log file.
        path: PathBuf,
        /// Why.
        source: std::io::Error,
    },
    /// The runtime that watches the processes cannot be started.
    #[error("cannot start the supervisor: {0}")]
    Runtime(std::io::Error),
}

/// How the end of a fleet went.
#[derive(Debug, Default, Clone, PartialEq, Eq)]
pub struct StopReport {
    /// Processes that did not end in time and were killed.
    pub killed: Vec<String>,
}

/// The processes of a run. Dropping it kills those that are left.
pub struct Supervisor {
    runtime: Runtime,
    watched: Vec<Watched>,
}

/// One process, as the supervisor holds it.
struct Watched {
    name: String,
    stop: watch::Sender<Option<Instant>>,
    task: JoinHandle<bool>,
}

impl Supervisor {
    /// Starts `specs` and watches over them; what happens is told to `events`.
    ///
    /// Standard output and error of each go to `<log_dir>/<name>.log`. A service that falls is started again after a
    /// pause, at most `restarts` times without a recovery in between.
    ///
    /// # Errors
    /// [`SuperviseError`] before anything is started.
    pub fn start(
        specs: Vec<ProcessSpec>,
        log_dir: &Path,
        restarts: u32,
        events: &Sender<ProcessEvent>,
    ) -> Result<Self, SuperviseError> {
        let mut logs = Vec::new();
        for spec in &specs {
            if !spec.program.is_file() {
                return Err(SuperviseError::NoProgram(spec.program.clone()));
            }
            logs.push(Log::create(log_dir.join(format!("{}.log", spec.name)))?);
        }
        let runtime = tokio::runtime::Builder::new_multi_thread()
            .worker_threads(1)
            .thread_name("supervisor")
            .enable_all()
            .build()
            .map_err(SuperviseError::Runtime)?;
        let watched = specs
            .into_iter()
            .zip(logs)
            .map(|(spec, log)| {
                let (name, (stop, told_to_stop)) = (spec.name.clone(), watch::channel(None));
                let watcher = Watcher { spec, log, restarts, events: events.clone(), stop: told_to_stop, falls: 0 };
                Watched { name, stop, task: runtime.spawn(watcher.run()) }
            })
            .collect();
        Ok(Self { runtime, watched })
    }

    /// Whether every process has ended for good.
    #[must_use]
    pub fn all_ended(&self) -> bool {
        self.watched.iter().all(|watched| watched.task.is_finished())
    }

    /// Ends the processes that `which` chooses by name: asks them with SIGTERM, kills what is left at `deadline`.
    /// Returns when they are gone.
    pub fn end(&mut self, which: impl Fn(&str) -> bool, deadline: Instant) -> StopReport {
        let (chosen, others) = self.watched.drain(..).partition(|watched| which(&watched.name));
        self.watched = others;
        let chosen: Vec<Watched> = chosen;
        for watched in &chosen {
            watched.stop.send_replace(Some(deadline));
        }
        let mut report = StopReport::default();
        for watched in chosen {
            if self.runtime.block_on(watched.task).unwrap_or(true) {
                report.killed.push(watched.name);
            }
        }
        report
    }

    /// Ends all processes within `grace`.
    pub fn stop(mut self, grace: Duration) -> StopReport {
        self.end(|_| true, Instant::now() + grace)
    }
}

/// Where the output of a process goes.
#[derive(Debug)]
struct Log {
    path: PathBuf,
    file: File,
}

impl Log {
    fn create(path: PathBuf) -> Result<Self, SuperviseError> {
        match OpenOptions::new().create(true).append(true).open(&path) {
            Ok(file) => Ok(Self { path, file }),
            Err(source) => Err(SuperviseError::Log { path, source }),
        }
    }

    /// The last line that says something.
    fn last_line(&self) -> Option<String> {
        let bytes = std::fs::read(&self.path).ok()?;
        let tail = String::from_utf8_lossy(&bytes[bytes.len().saturating_sub(4096)..]).into_owned();
        tail.lines().rev().map(str::trim).find(|line| !line.is_empty()).map(str::to_owned)
    }
}

/// Follows one process through its lives.
struct Watcher {
    spec: ProcessSpec,
    log: Log,
    restarts: u32,
    events: Sender<ProcessEvent>,
    stop: watch::Receiver<Option<Instant>>,
    falls: u32,
}

impl Watcher {
    /// Runs until told to stop or the process stays down. Returns whether it had to be killed.
    async fn run(mut self) -> bool {
        loop {
            let born = Instant::now();
            let how = match self.spawn() {
                Err(error) => format!("cannot be started: {error}"),
                Ok(mut child) => {
                    // Taken out, as waiting for a child closes the input that it still holds.
                    let _lifeline = child.stdin.take();
                    self.tell(Happening::Started { pid: child.id().unwrap_or(0) });
                    let stop = self.stop.clone();
                    tokio::select! {
                        status = child.wait() => match status {
                            Ok(status) if is_done(status) => {
                                self.tell(Happening::Done { data_lost: !status.success() });
                                return false;
                            }
                            Ok(status) if status.code() == Some(BAD_INPUT) => return self.give_up(&in_words(status)),
                            Ok(status) => in_words(status),
                            Err(error) => error.to_string(),
                        },
                        deadline = asked_to_stop(stop) => return end(child, deadline).await,
                    }
                }
            };
            if born.elapsed() > RECOVERED {
                self.falls = 0;
            }
            self.falls += 1;
            if self.spec.life != Life::Service || self.falls > self.restarts {
                return self.give_up(&how);
            }
            let pause = LONGEST_PAUSE.min(FIRST_PAUSE * (1 << (self.falls - 1).min(5)));
            self.tell(Happening::Fell { how, again_after: pause });
            tokio::select! {
                () = tokio::time::sleep(pause) => {}
                _ = asked_to_stop(self.stop.clone()) => return false,
            }
        }
    }

    fn spawn(&self) -> std::io::Result<Child> {
        Command::new(&self.spec.program)
            .args(&self.spec.args)
            .stdin(Stdio::piped())
            .stdout(self.log.file.try_clone()?)
            .stderr(self.log.file.try_clone()?)
            // Ctrl-C on a terminal reaches a whole process group: ours alone, so that the fleet ends in order.
            .process_group(0)
            .kill_on_drop(true)
            .spawn()
    }

    fn give_up(&self, how: &str) -> bool {
        let said = self.log.last_line().map_or(String::new(), |line| format!(": {line}"));
        let is_optional = self.spec.life == Life::Optional;
        self.tell(Happening::GaveUp { how: format!("{how}{said}"), is_optional });
        false
    }

    fn tell(&self, what: Happening) {
        // Nobody listens any more once the run is over.
        let _ = self.events.send(ProcessEvent { name: self.spec.name.clone(), what });
    }
}

/// Resolves with the deadline for ending.
async fn asked_to_stop(mut stop: watch::Receiver<Option<Instant>>) -> Instant {
    match stop.wait_for(Option::is_some).await {
        Ok(deadline) => deadline.unwrap_or_else(Instant::now),
        // The supervisor is gone.
        Err(_) => Instant::now(),
    }
}

/// Asks a process to end, kills it at the deadline. Returns whether it had to be killed.
async fn end(mut child: Child, deadline: Instant) -> bool {
    if let Some(pid) = child.id().and_then(|pid| Pid::from_raw(i32::try_from(pid).ok()?)) {
        // It may have ended in this very moment, which is as good.
        let _ = kill_process(pid, Signal::TERM);
    }
    if tokio::time::timeout_at(deadline.into(), child.wait()).await.is_ok() {
        return false;
    }
    // The wait after the kill cannot fail to end; an error means that it is gone already.
    let _ = child.kill().await;
    true
}

fn is_done(status: ExitStatus) -> bool {
    status.success() || status.code() == Some(DATA_LOST)
}

fn in_words(status: ExitStatus) -> String {
    match (status.code(), status.signal()) {
        (Some(code), _) => format!("ended with code {code}"),
        (None, Some(signal)) => format!("was ended by signal {signal}"),
        (None, None) => "ended".into(),
    }
}

#[cfg(test)]
mod tests {
    use std::sync::mpsc::{Receiver, channel};

    use super::*;

    const PATIENCE: Duration = Duration::from_secs(20);

    fn shell(name: &str, life: Life, script: &str) -> ProcessSpec {
        ProcessSpec { name: name.into(), program: "/bin/sh".into(), args: vec!["-c".into(), script.into()], life }
    }

    fn start(spec: ProcessSpec, restarts: u32) -> (Supervisor, Receiver<ProcessEvent>, tempfile::TempDir) {
        let folder = tempfile::tempdir().unwrap();
        let (events, received) = channel();
        (Supervisor::start(vec![spec], folder.path(), restarts, &events).unwrap(), received, folder)
    }

    fn next(events: &Receiver<ProcessEvent>) -> Happening {
        events.recv_timeout(PATIENCE).unwrap().what
    }

    #[test]
    fn who_ends_well_is_done() {
        let (supervisor, events, folder) = start(shell("job", Life::Service, "echo hello; exit 3"), 3);
        assert!(matches!(next(&events), Happening::Started { .. }));
        assert_eq!(next(&events), Happening::Done { data_lost: true });
        assert_eq!(std::fs::read_to_string(folder.path().join("job.log")).unwrap(), "hello\n");
        assert!(supervisor.stop(PATIENCE).killed.is_empty());
    }

    #[test]
    fn a_killed_service_is_started_again() {
        let (supervisor, events, _folder) = start(shell("car", Life::Service, "exec sleep 600"), 3);
        let Happening::Started { pid: first } = next(&events) else { panic!("not started") };
        kill_process(Pid::from_raw(first as i32).unwrap(), Signal::KILL).unwrap();
        let Happening::Fell { how, again_after } = next(&events) else { panic!("not fallen") };
        assert_eq!((how.as_str(), again_after), ("was ended by signal 9", FIRST_PAUSE));
        let Happening::Started { pid: second } = next(&events) else { panic!("not restarted") };
        assert_ne!(first, second);
        assert!(supervisor.stop(PATIENCE).killed.is_empty(), "sleep ends on SIGTERM");
    }

    #[test]
    fn a_service_that_keeps_falling_is_given_up_with_its_last_words() {
        let (_supervisor, events, _folder) = start(shell("car", Life::Service, "echo no engine >&2; exit 1"), 1);
        let happenings: Vec<_> = (0..4).map(|_| next(&events)).collect();
        assert!(matches!(&happenings[1], Happening::Fell { again_after, .. } if *again_after == FIRST_PAUSE));
        assert_eq!(happenings[3], Happening::GaveUp { how: "ended with code 1: no engine".into(), is_optional: false });
    }

    #[test]
    fn the_lifeline_holds_as_long_as_the_supervisor() {
        let (supervisor, events, folder) = start(shell("car", Life::Service, "echo up; cat; echo cut off"), 3);
        assert!(matches!(next(&events), Happening::Started { .. }));
        let log = folder.path().join("car.log");
        let began = Instant::now();
        while std::fs::read_to_string(&log).unwrap().is_empty() && began.elapsed() < PATIENCE {
            std::thread::yield_now();
        }
        // Its input does not end, so neither does it.
        assert!(events.recv_timeout(Duration::from_millis(200)).is_err());
        drop(supervisor.stop(PATIENCE));
        assert_eq!(std::fs::read_to_string(&log).unwrap(), "up\n");
    }

    #[test]
    fn bad_input_is_not_tried_again() {
        let (_supervisor, events, _folder) = start(shell("car", Life::Service, "echo bad map; exit 2"), 5);
        assert!(matches!(next(&events), Happening::Started { .. }));
        assert_eq!(next(&events), Happening::GaveUp { how: "ended with code 2: bad map".into(), is_optional: false });
    }

    #[test]
    fn who_ignores_the_request_is_killed_at_the_deadline() {
        let (supervisor, events, folder) =
            start(shell("deaf", Life::Service, "trap '' TERM; echo up; while :; do sleep 0.05; done"), 3);
        assert!(matches!(next(&events), Happening::Started { .. }));
        let log = folder.path().join("deaf.log");
        let began = Instant::now();
        while std::fs::read_to_string(&log).unwrap().is_empty() && began.elapsed() < PATIENCE {
            std::thread::yield_now();
        }
        let asked = Instant::now();
        assert_eq!(supervisor.stop(Duration::from_millis(300)).killed, ["deaf"]);
        assert!(asked.elapsed() < Duration::from_secs(4), "{:?}", asked.elapsed());
    }

    #[test]
    fn a_missing_program_is_named() {
        let (events, _received) = channel();
        let spec =
            ProcessSpec { name: "agent".into(), program: "/nowhere/agent".into(), args: vec![], life: Life::Service };
        let folder = tempfile::tempdir().unwrap();
        let error = Supervisor::start(vec![spec], folder.path(), 0, &events).err().unwrap();
        assert!(error.to_string().starts_with("/nowhere/agent is missing"), "{error}");
    }
}
