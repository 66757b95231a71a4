//! Process supervision: starts, logs, restarts and ends the processes of a run.
//!
//! The standard input of every process is a parent-death pipe: the supervisor holds the other end and never writes, so
//! that any end of the supervisor ends the fleet.

mod log_lines;
#[cfg(test)]
mod tests;
mod watcher;

use std::ffi::OsString;
use std::net::SocketAddr;
use std::path::{Path, PathBuf};
use std::sync::mpsc::Sender;
use std::time::{Duration, Instant};

use support::file_error::FileError;
use tokio::runtime::Runtime;
use tokio::sync::{mpsc, watch};
use tokio::task::JoinHandle;

use watcher::{Log, Watcher};

/// One process of the fleet.
#[derive(Debug, Clone)]
pub struct ProcessSpec {
    /// Name in messages and of its log.
    pub name: String,
    /// Path of the executable.
    pub program: PathBuf,
    /// Its arguments.
    pub args: Vec<OsString>,
    /// Restart policy.
    pub life: RestartPolicy,
    /// Address of its Prometheus endpoint, if it has one.
    pub metrics: Option<SocketAddr>,
}

/// Restart policy of a process.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum RestartPolicy {
    /// Works until the run is over; restarted when it ends before.
    Service,
    /// Has one task. When something ends it before the task is done, it is restarted and resumes; when it reports
    /// itself that the task is impossible, it stays down.
    Task,
    /// Has one task, which cannot be resumed; when it fails, it stays down, and the run goes on without it.
    Optional,
}

/// Event of a process.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ProcessEvent {
    /// Name of the process.
    pub name: String,
    /// Kind of the event.
    pub what: ProcessEventKind,
}

/// Kind of an event.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum ProcessEventKind {
    /// The process runs.
    Started {
        /// Its process id.
        pid: u32,
    },
    /// It crashed and will be restarted after a pause.
    Crashed {
        /// Description of its end.
        how: String,
        /// Length of the pause.
        again_after: Duration,
        /// Number of this restart, from 1.
        restart: u32,
    },
    /// It crashed and stays down.
    GaveUp {
        /// Description of its end, with the last line of its log.
        how: String,
        /// True if the run can go on without it.
        is_optional: bool,
    },
    /// It printed a line of its report.
    Logged {
        /// The line.
        line: String,
    },
    /// It was asked to end, and ended in another way than expected.
    Failed {
        /// Description of its end.
        how: String,
    },
    /// It ended as expected, by itself or on request.
    Done {
        /// True if it reports lost data.
        data_lost: bool,
    },
}

/// Reason why a process could not be started.
#[derive(Debug, thiserror::Error)]
pub enum SuperviseError {
    /// The executable does not exist.
    #[error("{} is missing: build it (cargo build --release), it belongs beside v2vloc", .0.display())]
    NoProgram(PathBuf),
    /// The log cannot be written.
    #[error("cannot write the log {0}")]
    Log(#[source] FileError),
    /// The runtime of the supervisor cannot be started.
    #[error("cannot start the supervisor: {0}")]
    Runtime(std::io::Error),
}

/// Processes of a run. Dropping it kills those that still run.
pub struct Supervisor {
    runtime: Runtime,
    watched: Vec<WatchedProcess>,
}

/// State of one supervised process.
struct WatchedProcess {
    name: String,
    stop: watch::Sender<Option<Instant>>,
    replace: mpsc::Sender<String>,
    task: JoinHandle<bool>,
}

impl Supervisor {
    /// Starts `specs` and supervises them; sends their events to `events`.
    ///
    /// Standard output and error of each go to `<log_dir>/<name>.log`. A service that crashes is restarted after a
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
        let mut watched = Vec::new();
        for (spec, log) in specs.into_iter().zip(logs) {
            let (name, (stop, stop_request)) = (spec.name.clone(), watch::channel(None));
            let (replace, replace_request) = mpsc::channel(1);
            let watcher = Watcher {
                spec,
                log,
                restarts,
                events: events.clone(),
                stop: stop_request,
                replace: replace_request,
            };
            watched.push(WatchedProcess {
                name,
                stop,
                replace,
                task: runtime.spawn(watcher.run()),
            });
        }
        Ok(Self { runtime, watched })
    }

    /// True if every process has ended for good.
    pub fn all_ended(&self) -> bool {
        let mut watched = self.watched.iter();
        watched.all(|watched| watched.task.is_finished())
    }

    /// Kills a hung process; then the rules of a crash apply. `why` describes the problem.
    pub fn replace(&self, name: &str, why: &str) {
        if let Some(watched) = self.watched.iter().find(|watched| watched.name == name) {
            // Full: it is being replaced already.
            let _ = watched.replace.try_send(why.to_owned());
        }
    }

    /// Ends the processes that `which` selects by name: SIGTERM, then SIGKILL at `deadline`. Returns when they have
    /// ended, with the names of those that were killed.
    pub fn end(&mut self, which: impl Fn(&str) -> bool, deadline: Instant) -> Vec<String> {
        let chosen = self.watched.extract_if(.., |watched| which(&watched.name));
        let chosen: Vec<WatchedProcess> = chosen.collect();
        // All are asked before any is waited for, so that they end at the same time.
        for watched in &chosen {
            watched.stop.send_replace(Some(deadline));
        }
        let mut killed = Vec::new();
        for watched in chosen {
            // A watcher that panicked has dropped its child, which kills it.
            if self.runtime.block_on(watched.task).unwrap_or(true) {
                killed.push(watched.name);
            }
        }
        killed
    }

    /// Ends all processes within `grace`; names those that were killed.
    pub fn stop(mut self, grace: Duration) -> Vec<String> {
        self.end(|_| true, Instant::now() + grace)
    }
}
