//! Shutdown on request, within a time limit.

use std::sync::mpsc;
use std::sync::{Arc, Condvar, Mutex, PoisonError};
use std::thread;
use std::time::{Duration, Instant};

use support::sync::{lock, spawn};

/// Maximum duration of a shutdown after the request: within the 5 s of a whole fleet.
pub const STOP_LIMIT: Duration = Duration::from_secs(4);

#[derive(Default)]
struct StopState {
    requested: bool,
    reactions: Vec<Box<dyn FnOnce() + Send>>,
}

/// A stop request that every thread of a process can read, make, wait for and react to.
#[derive(Clone, Default)]
pub struct Stop(Arc<(Mutex<StopState>, Condvar)>);

impl Stop {
    /// A request that has not been made.
    pub fn new() -> Self {
        Self::default()
    }

    /// The request of a process: made by signals and, under a supervisor, by the end of standard input; enforced after
    /// [`STOP_LIMIT`].
    ///
    /// # Errors
    /// When handlers or threads cannot be installed.
    pub fn of_process(is_supervised: bool) -> std::io::Result<Self> {
        let stop = Self::new();
        stop.on_signals()?;
        if is_supervised {
            stop.on_end_of_input()?;
        }
        stop.enforce(STOP_LIMIT);
        Ok(stop)
    }

    /// Requests the stop; the first request runs the reactions.
    pub fn request(&self) {
        let reactions = {
            let mut state = lock(&self.0.0);
            state.requested = true;
            std::mem::take(&mut state.reactions)
        };
        // The lock is free from here on: reactions may use this request.
        self.0.1.notify_all();
        for reaction in reactions {
            reaction();
        }
    }

    /// True if the stop has been requested.
    pub fn requested(&self) -> bool {
        lock(&self.0.0).requested
    }

    /// Runs `reaction` at the request, at once if it has been made. It must not wait: it is meant for closing the queue
    /// at which a thread waits.
    pub fn on_request(&self, reaction: impl FnOnce() + Send + 'static) {
        let mut state = lock(&self.0.0);
        if state.requested {
            // Released first: the reaction may use this request, whose lock is not reentrant.
            drop(state);
            reaction();
        } else {
            state.reactions.push(Box::new(reaction));
        }
    }

    /// Waits for the request, at most until `deadline`; true if it was made.
    pub fn wait_until(&self, deadline: Instant) -> bool {
        let left = deadline.saturating_duration_since(Instant::now());
        let (state, changed) = &*self.0;
        let waited = changed.wait_timeout_while(lock(state), left, |state| !state.requested);
        let (state, _) = waited.unwrap_or_else(PoisonError::into_inner);
        state.requested
    }

    /// Makes Ctrl-C and SIGTERM a request. A second one ends the process at once, with exit code 130.
    ///
    /// # Errors
    /// When the signal handlers cannot be installed.
    pub fn on_signals(&self) -> std::io::Result<()> {
        let runtime = tokio::runtime::Builder::new_multi_thread()
            .worker_threads(1)
            .enable_all()
            .build()?;
        // Installed here, not on the thread: a failure is an error of this call.
        let (mut interrupt, mut terminate) = {
            use tokio::signal::unix::{SignalKind, signal};
            let _inside = runtime.enter();
            (
                signal(SignalKind::interrupt())?,
                signal(SignalKind::terminate())?,
            )
        };
        let stop = self.clone();
        spawn("signals", move || {
            runtime.block_on(async {
                loop {
                    tokio::select! {
                        _ = interrupt.recv() => {}
                        _ = terminate.recv() => {}
                    }
                    if stop.requested() {
                        std::process::exit(130);
                    }
                    stop.request();
                }
            });
        })?;
        Ok(())
    }

    /// Makes the end of standard input a request (parent-death pipe): a supervisor that holds the other end of the pipe
    /// and writes nothing ends its processes with itself, however suddenly it dies.
    ///
    /// # Errors
    /// When the thread that waits for it cannot be started.
    fn on_end_of_input(&self) -> std::io::Result<()> {
        let stop = self.clone();
        spawn("parent-death", move || {
            // A broken pipe is an end of input too.
            let _ = std::io::copy(&mut std::io::stdin(), &mut std::io::sink());
            stop.request();
        })?;
        Ok(())
    }

    /// Ends the process with exit code 1 if it has not ended by itself `limit` after the first request: a stalled
    /// network must not keep it.
    fn enforce(&self, limit: Duration) {
        self.on_request(move || {
            // Without a thread for it, the operator can still press Ctrl-C a second time.
            let _ = spawn("enforcer", move || {
                thread::sleep(limit);
                tracing::error!("not ended {limit:?} after the request: exit without cleanup");
                std::process::exit(1);
            });
        });
    }
}

/// The shutdown exceeded its time limit.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[error("{what} did not end within {limit:?}")]
pub struct Overdue {
    /// Part that was being ended.
    pub what: &'static str,
    /// Time limit.
    pub limit: Duration,
}

/// Runs `teardown` on a thread of its own and waits for it for at most `limit`.
///
/// Closing a zenoh session over a dead link takes 10 s and undeclaring has no limit at all, so neither may run on a
/// thread that others wait for. An overdue teardown is abandoned; the end of the process ends it.
///
/// # Errors
/// [`Overdue`] when it is not done in time.
pub fn within<T: Send + 'static>(
    limit: Duration,
    what: &'static str,
    teardown: impl FnOnce() -> T + Send + 'static,
) -> Result<T, Overdue> {
    let (done, wait) = mpsc::sync_channel(1);
    let helper = spawn(format!("end-{what}"), move || {
        // The receiver is gone only after the timeout.
        let _ = done.send(teardown());
    });
    let overdue = Overdue { what, limit };
    helper.map_err(|_| overdue)?;
    wait.recv_timeout(limit).map_err(|_| overdue)
}

#[cfg(test)]
mod tests {
    use std::sync::atomic::{AtomicUsize, Ordering};

    use super::*;

    #[test]
    fn reactions_run_once_however_late_they_come() {
        let (stop, runs) = (Stop::new(), Arc::new(AtomicUsize::new(0)));
        let count = |runs: &Arc<AtomicUsize>| {
            let runs = Arc::clone(runs);
            move || {
                runs.fetch_add(1, Ordering::Relaxed);
            }
        };
        stop.on_request(count(&runs));
        assert!(!stop.requested());
        stop.request();
        stop.request();
        stop.on_request(count(&runs));
        assert!(stop.requested());
        assert_eq!(runs.load(Ordering::Relaxed), 2);
    }

    #[test]
    fn waiting_ends_with_the_request_or_the_deadline() {
        let stop = Stop::new();
        assert!(!stop.wait_until(Instant::now() + Duration::from_millis(5)));
        let waiter = thread::spawn({
            let stop = stop.clone();
            move || stop.wait_until(Instant::now() + Duration::from_secs(60))
        });
        stop.request();
        assert!(waiter.join().unwrap());
    }

    #[test]
    fn a_teardown_that_hangs_is_abandoned() {
        let (release, hang) = mpsc::channel::<()>();
        let overdue = within(Duration::from_millis(20), "a dead link", move || {
            hang.recv()
        })
        .unwrap_err();
        assert_eq!(overdue.to_string(), "a dead link did not end within 20ms");
        drop(release);
        assert_eq!(within(Duration::from_secs(60), "a live one", || 7), Ok(7));
    }
}
