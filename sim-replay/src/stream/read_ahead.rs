//! Read-ahead: reads the next ticks from disk during the wait for the current one.

use std::collections::BTreeMap;
use std::sync::mpsc::{Receiver, Sender, channel};
use std::sync::{Arc, Weak};

use dataset::frame::Frame;
use dataset::{LoadOptions, ReadError, Scenario};
use support::sync::spawn;

/// The frames of one tick, one for each requested agent, in that order.
pub(crate) type TickFrames = Vec<Result<Frame, ReadError>>;

/// A tick to be read, where its frames are sent, and a mark that is dead if it is no longer requested.
type Request = (usize, Sender<TickFrames>, Weak<()>);

/// The frames of a tick that was requested, and the mark that it is.
type Awaited = (Receiver<TickFrames>, Arc<()>);

/// A thread that reads the requested ticks, in order, and keeps no others. It ends with this value.
pub(crate) struct ReadAhead {
    requests: Sender<Request>,
    awaited: BTreeMap<usize, Awaited>,
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
        let (requests, received) = channel::<Request>();
        spawn("read ahead", move || {
            for (tick, sender, is_wanted) in received {
                // The tick may no longer be requested after a jump.
                if is_wanted.strong_count() > 0 {
                    let agents = agents.iter();
                    let frames = agents.map(|&agent| scenario.load(agent, tick, &options));
                    // Nobody receives them if the jump came meanwhile.
                    let _ = sender.send(frames.collect());
                }
            }
        })?;
        Ok(Self {
            requests,
            awaited: BTreeMap::new(),
        })
    }

    /// Sets the ticks that will be taken next, in order; other frames that were read are dropped.
    pub(crate) fn want(&mut self, ticks: &[usize]) {
        self.awaited.retain(|tick, _| ticks.contains(tick));
        for &tick in ticks {
            let awaited = self.awaited.entry(tick);
            awaited.or_insert_with(|| request(&self.requests, tick));
        }
    }

    /// The frames of a tick, as soon as they are read; empty if the reading thread has ended.
    pub(crate) fn take(&mut self, tick: usize) -> TickFrames {
        let awaited = self.awaited.remove(&tick);
        let (frames, _is_wanted) = awaited.unwrap_or_else(|| request(&self.requests, tick));
        frames.recv().unwrap_or_default()
    }
}

fn request(requests: &Sender<Request>, tick: usize) -> Awaited {
    let ((sender, frames), wanted) = (channel(), Arc::new(()));
    // Without the thread nothing is sent, and the receiver notices.
    let _ = requests.send((tick, sender, Arc::downgrade(&wanted)));
    (frames, wanted)
}
