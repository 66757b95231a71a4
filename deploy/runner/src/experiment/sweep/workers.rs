//! Worker processes of a sweep, each with one compute thread.
//!
//! A worker is this program with `--worker`: it reads the number and the identity of a run from standard input, computes
//! it, caches it, and answers on standard output: `frame` for each frame, then `done`, or `failed` with the reason.

use std::io::{BufRead, BufReader, Write};
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::sync::Mutex;

use super::SweepError;
use crate::experiment::cell::CellKey;

/// Answer of a worker: a frame is computed.
pub(super) const FRAME: &str = "frame";
/// The run is cached.
pub(super) const DONE: &str = "done";
/// The run failed; the reason follows on the same line.
pub(super) const FAILED: &str = "failed";

/// Number and identity of a run.
type Request<'r> = (usize, &'r CellKey);

/// Computes these runs with `jobs` processes; calls `on_frame` and `on_done` for each frame and run.
pub(super) fn run(
    file: &Path,
    out: &Path,
    missing: &[Request<'_>],
    jobs: usize,
    on_frame: &(dyn Fn() + Sync),
    on_done: &(dyn Fn() + Sync),
) -> Result<(), SweepError> {
    let queue = Mutex::new(missing.iter().copied());
    let failure = Mutex::new(None);
    std::thread::scope(|scope| {
        for _ in 0..jobs.min(missing.len()) {
            scope.spawn(|| {
                if let Err(error) = serve(file, out, &queue, &failure, on_frame, on_done) {
                    failure
                        .lock()
                        .unwrap_or_else(std::sync::PoisonError::into_inner)
                        .get_or_insert(error);
                }
            });
        }
    });
    failure
        .into_inner()
        .unwrap_or_else(std::sync::PoisonError::into_inner)
        .map_or(Ok(()), Err)
}

/// Feeds one worker until no run is left, or another worker has failed.
fn serve<'r>(
    file: &Path,
    out: &Path,
    queue: &Mutex<impl Iterator<Item = Request<'r>>>,
    failure: &Mutex<Option<SweepError>>,
    on_frame: &dyn Fn(),
    on_done: &dyn Fn(),
) -> Result<(), SweepError> {
    let mut worker = Worker(start(file, out)?);
    let silent = || SweepError::Worker("it ended without an answer".into());
    let mut input = worker.0.stdin.take().ok_or_else(silent)?;
    let mut output = BufReader::new(worker.0.stdout.take().ok_or_else(silent)?).lines();
    loop {
        if failure
            .lock()
            .unwrap_or_else(std::sync::PoisonError::into_inner)
            .is_some()
        {
            return Ok(());
        }
        let Some(request) = queue
            .lock()
            .unwrap_or_else(std::sync::PoisonError::into_inner)
            .next()
        else {
            return Ok(());
        };
        let request = serde_json::to_string(&request).unwrap_or_default();
        writeln!(input, "{request}").map_err(|error| SweepError::Worker(error.to_string()))?;
        loop {
            let line = output
                .next()
                .ok_or_else(silent)?
                .map_err(|error| SweepError::Worker(error.to_string()))?;
            match line.split_once(' ').unwrap_or((line.as_str(), "")) {
                (FRAME, _) => on_frame(),
                (DONE, _) => break on_done(),
                (FAILED, reason) => return Err(SweepError::Worker(reason.to_owned())),
                _ => return Err(SweepError::Worker(format!("unexpected answer {line:?}"))),
            }
        }
    }
}

fn start(file: &Path, out: &Path) -> Result<Child, SweepError> {
    let program = std::env::current_exe().map_err(|source| SweepError::Io {
        path: "this program".into(),
        source,
    })?;
    Command::new(&program)
        .args([
            "sweep".as_ref(),
            file.as_os_str(),
            "--out".as_ref(),
            out.as_os_str(),
            "--worker".as_ref(),
        ])
        .stdin(Stdio::piped())
        .stdout(Stdio::piped())
        .spawn()
        .map_err(|source| SweepError::Io {
            path: program,
            source,
        })
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
