//! What a process says about itself: which routes it has heard, how its books stand.
//!
//! One thread says it all, so that neither zenoh's callbacks nor the threads that work wait for the network.

use std::collections::BTreeSet;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::thread::{self, JoinHandle};
use std::time::{Duration, Instant};

use protocol::{CavId, Control, Key, Payload, RunId, Stamp, Stats, Topic, wire};
use zenoh::qos::{CongestionControl, Priority};
use zenoh::{Session, Wait};

use super::bounded_queue::{BoundedQueue, Pop, PushOutcome};
use super::publisher::{payload, unix_nanos};
use super::watchdog::Watchdog;
use super::{BusError, MessageStats};

/// How often a process says how its books stand and which routes it has heard, beside every time it hears a probe.
const PERIOD: Duration = Duration::from_millis(500);
/// Things waiting to be said.
const PLACES: usize = 64;
/// Topics a process reports as heard: whoever receives the list bounds it too.
const MAX_HEARD: usize = 512;

enum Notice {
    Ready,
    Say { control: Control, capture_nanos: u64 },
}

/// A handle to the thread that speaks for this process.
#[derive(Clone)]
pub(super) struct StatusPublisher(Arc<Shared>);

struct Shared {
    heard: Mutex<BTreeSet<Topic>>,
    // Many probes need one answer.
    answer_due: AtomicBool,
    // Of the thread that works, while it does.
    pulse: Mutex<Option<Arc<Watchdog>>>,
    queue: BoundedQueue<(), Notice>,
}

impl StatusPublisher {
    pub(super) fn new() -> Self {
        let queue = BoundedQueue::new(PLACES, 1);
        Self(Arc::new(Shared {
            heard: Mutex::default(),
            answer_due: AtomicBool::new(false),
            pulse: Mutex::default(),
            queue,
        }))
    }

    /// A message has come on `topic`: its route stands.
    pub(super) fn heard(&self, topic: &Topic) {
        let mut heard = self.0.heard.lock().unwrap_or_else(PoisonError::into_inner);
        if heard.len() < MAX_HEARD && !heard.contains(topic) {
            heard.insert(topic.clone());
        }
    }

    /// A probe has come on `topic`: whoever holds the clock may be waiting for the answer.
    pub(super) fn probed(&self, topic: &Topic) {
        self.heard(topic);
        if !self.0.answer_due.swap(true, Ordering::AcqRel) {
            self.push(Notice::Ready);
        }
    }

    /// Says `control` to all who listen.
    pub(super) fn say(&self, control: Control, capture_nanos: u64) {
        self.push(Notice::Say { control, capture_nanos });
    }

    /// How the books stand is said only while this thread works; `None`: always.
    pub(super) fn watch(&self, pulse: Option<Arc<Watchdog>>) {
        *self.0.pulse.lock().unwrap_or_else(PoisonError::into_inner) = pulse;
    }

    /// Ends the thread after it has said what is queued, and how the books stand at the end.
    pub(super) fn close(&self) {
        self.0.queue.close();
    }

    fn push(&self, notice: Notice) {
        match self.0.queue.push((), notice) {
            PushOutcome::Replaced(Notice::Say { control, .. }) => {
                tracing::error!("the network is stuck: {control:?} was not sent");
            }
            PushOutcome::Queued
            | PushOutcome::Replaced(Notice::Ready)
            | PushOutcome::NoLane(_)
            | PushOutcome::Closed(_) => {}
        }
    }

    pub(super) fn speak(&self, speaker: StatusSender) -> Result<JoinHandle<()>, BusError> {
        let shared = Arc::clone(&self.0);
        thread::Builder::new()
            .name("notices".into())
            .spawn(move || speaker.run(&shared))
            .map_err(|cause| BusError::Thread { what: "notices".into(), cause })
    }
}

/// The thread's side.
pub(super) struct StatusSender {
    pub(super) session: Session,
    pub(super) run: RunId,
    pub(super) cav: CavId,
    pub(super) epoch: u64,
    pub(super) books: MessageStats,
}

impl StatusSender {
    fn run(self, shared: &Shared) {
        let (mut sequence, mut beats) = (0, 0);
        let mut next = Instant::now() + PERIOD;
        loop {
            match shared.queue.take(Some(next)) {
                Pop::Item((), Notice::Ready) => self.ready(shared, &mut sequence),
                Pop::Item((), Notice::Say { control, capture_nanos }) => {
                    self.control(control, capture_nanos, &mut sequence);
                }
                Pop::TimedOut => {
                    next = Instant::now() + PERIOD;
                    self.ready(shared, &mut sequence);
                    let pulse = shared.pulse.lock().unwrap_or_else(PoisonError::into_inner).clone();
                    if pulse.is_none_or(|pulse| pulse.is_alive(&mut beats)) {
                        self.stats(&mut sequence);
                    }
                }
                Pop::Closed => return self.stats(&mut sequence),
            }
        }
    }

    fn ready(&self, shared: &Shared, sequence: &mut u64) {
        // Cleared first: a probe that comes from here on asks anew.
        shared.answer_due.store(false, Ordering::Release);
        let heard: Vec<Topic> = shared.heard.lock().unwrap_or_else(PoisonError::into_inner).iter().cloned().collect();
        if !heard.is_empty() {
            let process = self.books.process().clone();
            let key = Key::ready(&self.run, &process);
            self.put(&key, Priority::InteractiveHigh, 0, Control::Ready { process, heard }, sequence);
        }
    }

    fn control(&self, control: Control, capture_nanos: u64, sequence: &mut u64) {
        if let Some(verb) = control.verb() {
            self.put(&Key::control(&self.run, verb), Priority::InteractiveHigh, capture_nanos, control, sequence);
        }
    }

    fn stats(&self, sequence: &mut u64) {
        let process = self.books.process().clone();
        let key = Key::stats(&self.run, &process);
        let stats = Stats { process, ledger: self.books.ledger(), stages: self.books.stages() };
        self.put(&key, Priority::Background, 0, stats, sequence);
    }

    fn put<M: Payload>(&self, key: &Key, priority: Priority, capture_nanos: u64, message: M, sequence: &mut u64) {
        let stamp = Stamp {
            cav: self.cav.clone(),
            epoch: self.epoch,
            sequence: *sequence,
            capture_nanos,
            publish_nanos: unix_nanos(),
        };
        *sequence += 1;
        let encoded = match wire::encode(&stamp, message) {
            Ok(encoded) => encoded,
            Err(error) => return tracing::error!(%key, "notice cannot be sent: {error}"),
        };
        let put = self.session.put(key.to_string(), payload(encoded));
        let put = put.congestion_control(CongestionControl::Block).priority(priority).express(true);
        if let Err(cause) = put.wait() {
            tracing::error!(%key, "zenoh refuses a notice: {cause}");
        }
    }
}
