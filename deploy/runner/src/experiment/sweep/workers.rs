//! Worker processes of a sweep, each with one compute thread.
//!
//! A worker is this program with `--worker`: it reads the number and the identity of a run from standard input, computes
//! it, caches it, and answers on standard output: `frame` for each frame, then `done`, or `refused` or `failed` with the
//! reason.

use std::io::{self, BufRead, BufReader, Write};
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::sync::{Mutex, PoisonError};

use anyhow::{Context, Error, Result};
use support::cli::NotWritten;
use support::file_error::NoSpace;
use support::sync::lock;

use super::WorkerError;
use crate::experiment::cell::CellKey;

/// Answer of a worker: a frame is computed.
pub(super) const FRAME: &str = "frame";
/// The run is cached.
pub(super) const DONE: &str = "done";
/// The input of the run is at fault; the reason follows on the same line.
const REFUSED: &str = "refused";
/// The run failed without a fault of the input; the reason follows on the same line.
const FAILED: &str = "failed";

/// Computes these runs, of a number and an identity each, with `jobs` processes; calls `on_frame` and `on_done` for each
/// frame and run.
pub(super) fn run(
    file: &Path,
    out: &Path,
    missing: &[(usize, &CellKey)],
    jobs: usize,
    on_frame: &(dyn Fn() + Sync),
    on_done: &(dyn Fn() + Sync),
) -> Result<()> {
    let queue = Mutex::new(missing.iter().copied());
    let failure: Mutex<Option<Error>> = Mutex::new(None);
    // Feeds one worker until no run is left, or another worker has failed.
    let serve = || -> Result<()> {
        // Wrapped at once, so that no early return leaves the process behind.
        let mut worker = Worker(start(file, out)?);
        let mut input = worker.0.stdin.take().ok_or_else(silent)?;
        let mut output = BufReader::new(worker.0.stdout.take().ok_or_else(silent)?).lines();
        loop {
            // After a failure of one worker the others finish their current run and take no other.
            let has_failed = lock(&failure).is_some();
            let request = lock(&queue).next();
            let Some(request) = request.filter(|_| !has_failed) else {
                return Ok(());
            };
            let request = serde_json::to_string(&request)?;
            writeln!(input, "{request}").map_err(|error| WorkerError(error.to_string()))?;
            loop {
                let line = output.next().ok_or_else(silent)?;
                let line = line.map_err(|error| WorkerError(error.to_string()))?;
                match line.split_once(' ').unwrap_or((line.as_str(), "")) {
                    (FRAME, _) => on_frame(),
                    (DONE, _) => break on_done(),
                    // The error of this program without workers, so that exit code and message are the same.
                    (REFUSED, reason) => return Err(Error::msg(reason.to_owned())),
                    (FAILED, reason) => return Err(WorkerError(reason.to_owned()).into()),
                    _ => return Err(WorkerError(format!("unexpected answer {line:?}")).into()),
                }
            }
        }
    };
    std::thread::scope(|scope| {
        for _ in 0..jobs.min(missing.len()) {
            scope.spawn(|| {
                if let Err(error) = serve() {
                    lock(&failure).get_or_insert(error);
                }
            });
        }
    });
    let failure = failure.into_inner().unwrap_or_else(PoisonError::into_inner);
    failure.map_or(Ok(()), Err)
}

/// Answer to a run that was not computed. Only a place that cannot be written is no fault of the input.
pub(super) fn failure(error: &Error) -> String {
    let cause = error.root_cause();
    let of_system = cause.downcast_ref::<io::Error>();
    let is_full = cause.is::<NoSpace>() || of_system.is_some_and(|it| NoSpace::of(it).is_some());
    let is_of_writing = is_full || error.is::<NotWritten>();
    let answer = if is_of_writing { FAILED } else { REFUSED };
    format!("{answer} {error:#}")
}

fn silent() -> WorkerError {
    WorkerError("it ended without an answer".into())
}

fn start(file: &Path, out: &Path) -> Result<Child> {
    let program = std::env::current_exe().context("this program")?;
    let mut command = Command::new(&program);
    command.arg("sweep").arg(file).arg("--out").arg(out);
    command.arg("--worker");
    // Standard error stays that of the sweep, so that warnings of workers are seen.
    let child = command.stdin(Stdio::piped()).stdout(Stdio::piped()).spawn();
    child.with_context(|| program.display().to_string())
}

/// A process that is killed when it is dropped.
struct Worker(Child);

impl Drop for Worker {
    fn drop(&mut self) {
        // It ends by itself at the end of its input; one that hangs is killed.
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

#[cfg(test)]
mod tests {
    use std::io::ErrorKind;

    use super::*;

    #[test]
    fn an_answer_states_whether_the_input_is_at_fault() {
        let full = Error::from(io::Error::from(ErrorKind::StorageFull)).context("out/cells");
        assert!(failure(&full).starts_with("failed out/cells: "));
        let denied = Error::from(io::Error::from(ErrorKind::PermissionDenied));
        let denied = denied.context(NotWritten("out/maps".into()));
        assert!(failure(&denied).starts_with("failed out/maps cannot be written: "));
        let wrong = Error::msg("late.safetensors: cut off").context("weights");
        assert_eq!(
            failure(&wrong),
            "refused weights: late.safetensors: cut off"
        );
    }
}
