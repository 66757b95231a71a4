//! Watcher of one process: starts it, follows it and restarts it.

use std::fs::{File, OpenOptions};
use std::os::unix::process::ExitStatusExt;
use std::path::PathBuf;
use std::process::{ExitStatus, Stdio};
use std::sync::mpsc::Sender;
use std::time::{Duration, Instant};

use rustix::process::{Pid, Signal, kill_process};
use support::file_error::AtFile;
use tokio::process::{Child, Command};
use tokio::sync::{mpsc, watch};
use tokio::task::JoinHandle;

use super::{
    ProcessEvent, ProcessEventKind, ProcessSpec, RestartPolicy, SuperviseError, log_lines,
};

/// Exit code of our programs for bad usage or input: a restart cannot help.
const BAD_INPUT: i32 = 2;
/// Exit code of our programs for complete work with lost data.
const DATA_LOST: i32 = 3;
/// Exit code of a Rust program that panics.
const PANIC: i32 = 101;
/// Run time after which a process has recovered; its next crash counts as a first one.
const RECOVERED: Duration = Duration::from_secs(10);
/// First pause before a restart; it doubles up to [`LONGEST_PAUSE`].
pub(super) const FIRST_PAUSE: Duration = Duration::from_millis(200);
/// Longest wait for the rest of the report of a process that has ended.
const REPORT_TIMEOUT: Duration = Duration::from_secs(1);
/// Longest pause before a restart.
const LONGEST_PAUSE: Duration = Duration::from_secs(5);

/// Log file of a process.
#[derive(Debug)]
pub(super) struct Log {
    path: PathBuf,
    file: File,
}

impl Log {
    pub(super) fn create(path: PathBuf) -> Result<Self, SuperviseError> {
        let file = OpenOptions::new().create(true).append(true).open(&path);
        let file = file.at(&path).map_err(SuperviseError::Log)?;
        Ok(Self { path, file })
    }

    /// Last line that is not empty.
    fn last_line(&self) -> Option<String> {
        let bytes = std::fs::read(&self.path).ok()?;
        let tail = String::from_utf8_lossy(&bytes[bytes.len().saturating_sub(4096)..]).into_owned();
        let mut lines = tail.lines().rev().map(str::trim);
        lines.find(|line| !line.is_empty()).map(str::to_owned)
    }
}

/// Follows one process through its restarts.
pub(super) struct Watcher {
    pub(super) spec: ProcessSpec,
    pub(super) log: Log,
    pub(super) restarts: u32,
    pub(super) events: Sender<ProcessEvent>,
    pub(super) stop: watch::Receiver<Option<Instant>>,
    /// Reasons for which it is to be killed and restarted.
    pub(super) replace: mpsc::Receiver<String>,
}

impl Watcher {
    /// Runs until asked to stop or the process stays down. Returns true if it had to be killed.
    pub(super) async fn run(mut self) -> bool {
        // Crashes without a recovery in between, and all restarts.
        let (mut crashes, mut restarted) = (0_u32, 0_u32);
        loop {
            let born = Instant::now();
            let mut may_restart = self.spec.life != RestartPolicy::Optional;
            let how = match self.spawn() {
                Err(error) => format!("cannot be started: {error}"),
                Ok(mut child) => {
                    // Taken out, as waiting for a child closes the input that it still holds.
                    let _parent_death_pipe = child.stdin.take();
                    // Requests for the previous instance; who knows of this one may already ask for its end.
                    while self.replace.try_recv().is_ok() {}
                    self.report(ProcessEventKind::Started {
                        pid: child.id().unwrap_or(0),
                    });
                    let report = self.follow(&mut child);
                    let stop = self.stop.clone();
                    tokio::select! {
                        Some(why) = self.replace.recv() => {
                            // It cannot fail to end; an error means that the process has ended already.
                            let _ = child.kill().await;
                            why
                        },
                        status = child.wait() => match read_out(report, status).await {
                            Ok(status) if is_done(status) && self.spec.life != RestartPolicy::Service => {
                                self.report(ProcessEventKind::Done { data_lost: !status.success() });
                                return false;
                            }
                            Ok(status) if is_done(status) => "ended without a request".into(),
                            Ok(status) if status.code() == Some(BAD_INPUT) => return self.give_up(&describe(status)),
                            Ok(status) => {
                                // A task that reports its own failure would fail again.
                                // One that was struck down, by a signal or in a panic, can resume.
                                let was_struck = matches!(status.code(), None | Some(PANIC));
                                may_restart &= self.spec.life == RestartPolicy::Service || was_struck;
                                describe(status)
                            }
                            Err(error) => error.to_string(),
                        },
                        deadline = stop_requested(stop) => {
                            let status = end(&mut child, deadline).await;
                            let status = read_out(report, status).await;
                            return self.report_requested_end(status);
                        }
                    }
                }
            };
            if born.elapsed() > RECOVERED {
                crashes = 0;
            }
            crashes += 1;
            if !may_restart || crashes > self.restarts {
                return self.give_up(&how);
            }
            // The exponent is bounded, as the number of crashes is not.
            let pause = LONGEST_PAUSE.min(FIRST_PAUSE * (1 << (crashes - 1).min(5)));
            restarted += 1;
            self.report(ProcessEventKind::Crashed {
                how,
                again_after: pause,
                restart: restarted,
            });
            tokio::select! {
                () = tokio::time::sleep(pause) => {}
                _ = stop_requested(self.stop.clone()) => return false,
            }
        }
    }

    fn spawn(&self) -> std::io::Result<Child> {
        Command::new(&self.spec.program)
            .args(&self.spec.args)
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .stderr(self.log.file.try_clone()?)
            // Ctrl-C on a terminal reaches a whole process group: only that of this program, so that the fleet ends in
            // order.
            .process_group(0)
            .kill_on_drop(true)
            .spawn()
    }

    /// Reports the end of a process after a request. Returns true if it had to be killed.
    fn report_requested_end(&self, status: Option<ExitStatus>) -> bool {
        match status {
            None => return true,
            // Before it handles signals it has nothing to lose.
            Some(status) if is_done(status) || status.signal() == Some(Signal::TERM.as_raw()) => {
                self.report(ProcessEventKind::Done {
                    data_lost: status.code() == Some(DATA_LOST),
                });
            }
            Some(status) => self.report(ProcessEventKind::Failed {
                how: describe(status),
            }),
        }
        false
    }

    /// Copies and passes on the output of a process, in a task that ends with the output.
    fn follow(&self, child: &mut Child) -> Option<JoinHandle<()>> {
        let (output, log) = (child.stdout.take()?, self.log.file.try_clone().ok()?);
        let (events, name) = (self.events.clone(), self.spec.name.clone());
        Some(tokio::spawn(log_lines::follow(output, log, move |line| {
            let _ = events.send(ProcessEvent {
                name: name.clone(),
                what: ProcessEventKind::Logged { line },
            });
        })))
    }

    fn give_up(&self, how: &str) -> bool {
        let last_line = self.log.last_line().map_or(String::new(), |line| {
            format!(": {}", line.strip_prefix("error: ").unwrap_or(&line))
        });
        let is_optional = self.spec.life == RestartPolicy::Optional;
        self.report(ProcessEventKind::GaveUp {
            how: format!("{how}{last_line}"),
            is_optional,
        });
        false
    }

    fn report(&self, what: ProcessEventKind) {
        // Without a receiver, the run is over.
        let _ = self.events.send(ProcessEvent {
            name: self.spec.name.clone(),
            what,
        });
    }
}

/// Resolves with the deadline for ending.
async fn stop_requested(mut stop: watch::Receiver<Option<Instant>>) -> Instant {
    match stop.wait_for(Option::is_some).await {
        Ok(deadline) => deadline.unwrap_or_else(Instant::now),
        // The supervisor is gone.
        Err(_) => Instant::now(),
    }
}

/// Sends SIGTERM to a process, then SIGKILL at the deadline. Returns its exit status; `None`: it had to be killed.
async fn end(child: &mut Child, deadline: Instant) -> Option<ExitStatus> {
    if let Some(pid) = child
        .id()
        .and_then(|pid| Pid::from_raw(i32::try_from(pid).ok()?))
    {
        // It may have ended at this moment, which is as good.
        let _ = kill_process(pid, Signal::TERM);
        // A stopped process does not handle SIGTERM.
        let _ = kill_process(pid, Signal::CONT);
    }
    if let Ok(Ok(status)) = tokio::time::timeout_at(deadline.into(), child.wait()).await {
        return Some(status);
    }
    // The wait after the kill cannot fail to end; an error means that the process has ended already.
    let _ = child.kill().await;
    None
}

/// Exit status of a process, once its output has been read.
async fn read_out<T>(report: Option<JoinHandle<()>>, status: T) -> T {
    if let Some(report) = report {
        // Another holder of its output is not waited for.
        let _ = tokio::time::timeout(REPORT_TIMEOUT, report).await;
    }
    status
}

fn is_done(status: ExitStatus) -> bool {
    status.success() || status.code() == Some(DATA_LOST)
}

fn describe(status: ExitStatus) -> String {
    match (status.code(), status.signal()) {
        (Some(code), _) => format!("ended with code {code}"),
        (None, Some(signal)) => format!("was ended by signal {signal}"),
        (None, None) => "ended".into(),
    }
}
