//! Read-ahead: reads the next ticks from disk during the wait for the current one.

use std::collections::{BTreeMap, VecDeque};
use std::sync::{Arc, Condvar, Mutex};
use std::thread::{self, JoinHandle};
use std::time::Duration;

use dataset::frame::Frame;
use dataset::{LoadOptions, ReadError, Scenario};
use support::sync::{lock, wait, wait_at_most};

/// The frames of one tick, one for each requested agent, in that order.
pub(crate) type TickFrames = Vec<Result<Frame, ReadError>>;

#[derive(Default)]
struct ReadAheadState {
    wanted: VecDeque<usize>,
    ready: BTreeMap<usize, TickFrames>,
    is_closed: bool,
}

/// A thread that reads the requested ticks, in order, and keeps no others.
pub(crate) struct ReadAhead {
    shared: Arc<(Mutex<ReadAheadState>, Condvar)>,
    thread: Option<JoinHandle<()>>,
}

impl ReadAhead {
    /// Starts a thread that reads frames of `agents` (indices into the scenario's agents).
    ///
    /// # Errors
    /// If the system provides no thread.
    pub(crate) fn start(
        scenario: Scenario,
        agents: Vec<usize>,
        options: LoadOptions,
    ) -> std::io::Result<Self> {
        let shared: Arc<(Mutex<ReadAheadState>, Condvar)> = Arc::default();
        let thread = thread::Builder::new().name("read ahead".into()).spawn({
            let shared = Arc::clone(&shared);
            move || {
                while let Some(tick) = next_wanted(&shared) {
                    // Reading takes long, so the lock is not held meanwhile.
                    let frames = agents
                        .iter()
                        .map(|&agent| scenario.load(agent, tick, &options))
                        .collect();
                    let mut state = lock(&shared.0);
                    // The tick may no longer be requested after a jump.
                    if state.wanted.contains(&tick) {
                        state.ready.insert(tick, frames);
                        shared.1.notify_all();
                    }
                }
            }
        })?;
        Ok(Self {
            shared,
            thread: Some(thread),
        })
    }

    /// Sets the ticks that will be taken next, in order; other frames that were read are dropped.
    pub(crate) fn want(&self, ticks: &[usize]) {
        let mut state = lock(&self.shared.0);
        state.wanted = ticks.iter().copied().collect();
        state.ready.retain(|tick, _| ticks.contains(tick));
        self.shared.1.notify_all();
    }

    /// The frames of a requested tick, as soon as they are read; empty if the reading thread has ended.
    pub(crate) fn take(&self, tick: usize) -> TickFrames {
        let mut state = lock(&self.shared.0);
        loop {
            if let Some(frames) = state.ready.remove(&tick) {
                return frames;
            }
            if self.thread.as_ref().is_none_or(JoinHandle::is_finished) {
                return Vec::new();
            }
            if !state.wanted.contains(&tick) {
                state.wanted.push_front(tick);
                self.shared.1.notify_all();
            }
            // A thread that panics does not notify the waiters.
            state = wait_at_most(&self.shared.1, state, Duration::from_secs(1));
        }
    }
}

impl Drop for ReadAhead {
    fn drop(&mut self) {
        lock(&self.shared.0).is_closed = true;
        self.shared.1.notify_all();
        if let Some(thread) = self.thread.take() {
            // A panic of the reader was already reported.
            let _ = thread.join();
        }
    }
}

fn next_wanted(shared: &(Mutex<ReadAheadState>, Condvar)) -> Option<usize> {
    let mut state = lock(&shared.0);
    loop {
        if state.is_closed {
            return None;
        }
        let mut wanted = state.wanted.iter();
        if let Some(&tick) = wanted.find(|&tick| !state.ready.contains_key(tick)) {
            return Some(tick);
        }
        state = wait(&shared.1, state);
    }
}
