//! Keeps the processes of a run alive: starts them, logs them, starts the fallen again, ends them all in time.
//!
//! Every process reads its standard input as a lifeline: the supervisor holds the other end and never writes, so that
//! the death of the supervisor, however sudden, ends the fleet.

mod said;
#[cfg(test)]
mod tests;
mod watcher;

use std::ffi::OsString;
use std::net::SocketAddr;
use std::path::{Path, PathBuf};
use std::sync::mpsc::Sender;
use std::time::{Duration, Instant};

use tokio::runtime::Runtime;
use tokio::sync::{mpsc, watch};
use tokio::task::JoinHandle;

use watcher::{Log, Watcher};

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
    pub life: RestartPolicy,
    /// Where it serves its counters to Prometheus, if it does.
    pub metrics: Option<SocketAddr>,
}

/// What the end of a process means.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum RestartPolicy {
    /// It works until the run is over; when it ends before, it is started again.
    Service,
    /// It has one job. When something ends it before that is done it is started again and takes it up where it was; when it
    /// says itself that it cannot do it, it stays down.
    Task,
    /// It has one job, which cannot be taken up in the middle; when it fails, it stays down, and the run goes on without it.
    Optional,
}

/// What happened to a process.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ProcessEvent {
    /// Name of the process.
    pub name: String,
    /// What happened.
    pub what: ProcessEventKind,
}

/// What happened to a process.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum ProcessEventKind {
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
        /// Which restart of this process comes, counted from 1.
        restart: u32,
    },
    /// It fell and stays down.
    GaveUp {
        /// How it ended, in words, with the last line of its log.
        how: String,
        /// Whether the run can go on without it.
        is_optional: bool,
    },
    /// It printed a line of its report.
    Said {
        /// The line.
        line: String,
    },
    /// It was asked to end, and ended in another way than it should.
    Failed {
        /// How it ended, in words.
        how: String,
    },
    /// It ended as it should, by itself or as it was asked to.
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
    replace: mpsc::Sender<String>,
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
                let (replace, told_to_replace) = mpsc::channel(1);
                let watcher = Watcher {
                    spec,
                    log,
                    restarts,
                    events: events.clone(),
                    stop: told_to_stop,
                    replace: told_to_replace,
                    falls: 0,
                    restarted: 0,
                };
                Watched { name, stop, replace, task: runtime.spawn(watcher.run()) }
            })
            .collect();
        Ok(Self { runtime, watched })
    }

    /// Whether every process has ended for good.
    #[must_use]
    pub fn all_ended(&self) -> bool {
        self.watched.iter().all(|watched| watched.task.is_finished())
    }

    /// Kills a process that runs but does not work; what follows is what follows any other fall. `why` says in words what is
    /// wrong with it.
    pub fn replace(&self, name: &str, why: &str) {
        if let Some(watched) = self.watched.iter().find(|watched| watched.name == name) {
            // Full: it is being replaced already.
            let _ = watched.replace.try_send(why.to_owned());
        }
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
