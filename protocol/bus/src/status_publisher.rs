//! Status of a process: publishes its confirmed routes and its ledger.
//!
//! One thread publishes everything, so that neither zenoh's callbacks nor the worker threads wait for the network.

use std::collections::BTreeSet;
use std::mem;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use protocol::{Control, Key, Payload, Stats, Topic, wire};
use zenoh::qos::{CongestionControl, Priority};
use zenoh::{Session, Wait};

use support::sync::{lock, spawn};

use super::bounded_queue::{BoundedQueue, Pop, PushOutcome};
use super::process_usage::process_usage;
use super::publisher::{payload, stamp_now};
use super::watchdog::Watchdog;
use super::{BusError, Identity, MessageStats};

/// Interval of the heartbeats, which carry ledger and confirmed routes; probes are answered in addition.
const PERIOD: Duration = Duration::from_millis(500);
/// Maximum number of queued control messages.
const PLACES: usize = 64;
/// Maximum number of topics reported as confirmed, equal to the limit of receivers of the list.
const MAX_CONFIRMED: usize = 512;

enum StatusTask {
    Ready,
    /// With its capture time, nanoseconds.
    Control(Control, u64),
}

/// A handle to the status thread of this process.
#[derive(Clone)]
pub(super) struct StatusPublisher(Arc<StatusState>);

struct StatusState {
    confirmed: Mutex<BTreeSet<Topic>>,
    // Many probes need one answer.
    answer_due: AtomicBool,
    // Of the worker thread, while it works.
    watchdog: Mutex<Option<Arc<Watchdog>>>,
    queue: BoundedQueue<(), StatusTask>,
}

impl StatusPublisher {
    pub(super) fn new() -> Self {
        Self(Arc::new(StatusState {
            confirmed: Mutex::default(),
            answer_due: AtomicBool::new(false),
            watchdog: Mutex::default(),
            queue: BoundedQueue::new(PLACES, 1),
        }))
    }

    /// Marks the route of `topic` as confirmed.
    pub(super) fn confirm_route(&self, topic: &Topic) {
        let mut confirmed = lock(&self.0.confirmed);
        if confirmed.len() < MAX_CONFIRMED && !confirmed.contains(topic) {
            confirmed.insert(topic.clone());
        }
    }

    /// Requests an answer to a probe on `topic`: the process that holds the clock may be waiting for it.
    pub(super) fn probed(&self, topic: &Topic) {
        self.confirm_route(topic);
        if !self.0.answer_due.swap(true, Ordering::AcqRel) {
            self.push(StatusTask::Ready);
        }
    }

    /// Publishes `control`.
    pub(super) fn publish(&self, control: Control, capture_nanos: u64) {
        self.push(StatusTask::Control(control, capture_nanos));
    }

    /// Heartbeats are published only while this thread works; `None`: always.
    pub(super) fn watch(&self, watchdog: Option<Arc<Watchdog>>) {
        *lock(&self.0.watchdog) = watchdog;
    }

    /// Ends the thread after it has published the queued messages and the final ledger.
    pub(super) fn close(&self) {
        self.0.queue.close();
    }

    fn push(&self, request: StatusTask) {
        let outcome = self.0.queue.push((), request);
        if let PushOutcome::Replaced(StatusTask::Control(control, _)) = outcome {
            tracing::error!("the network is stalled: {control:?} was not sent");
        }
    }

    pub(super) fn start(&self, sender: StatusSender) -> Result<JoinHandle<()>, BusError> {
        let shared = Arc::clone(&self.0);
        let thread = spawn("status", move || sender.run(&shared));
        thread.map_err(BusError::thread("status"))
    }
}

/// State of the status thread.
pub(super) struct StatusSender {
    pub(super) session: Session,
    pub(super) identity: Identity,
    pub(super) epoch: u64,
    pub(super) stats: MessageStats,
    pub(super) sequence: u64,
    /// True once what the process has used to load its models is reported.
    pub(super) is_start_reported: bool,
}

impl StatusSender {
    fn run(mut self, shared: &StatusState) {
        let mut beats = 0;
        let mut next = Instant::now() + PERIOD;
        loop {
            match shared.queue.take(Some(next)) {
                Pop::Item((), StatusTask::Ready) => self.ready(shared),
                Pop::Item((), StatusTask::Control(control, nanos)) => {
                    if let Some(verb) = control.verb() {
                        let key = Topic::Control(verb).in_run(&self.identity.run);
                        self.put(&key, Priority::InteractiveHigh, nanos, control);
                    }
                }
                Pop::TimedOut => {
                    // From now, not from the time due: no burst of heartbeats follows a stall.
                    next = Instant::now() + PERIOD;
                    self.ready(shared);
                    let watchdog = lock(&shared.watchdog).clone();
                    if watchdog.is_none_or(|watchdog| watchdog.is_alive(&mut beats)) {
                        self.stats(Priority::Background);
                    }
                }
                Pop::Closed => return self.stats(Priority::Background),
            }
        }
    }

    fn ready(&mut self, shared: &StatusState) {
        // Cleared first: a probe that arrives from here on requests a new answer.
        shared.answer_due.store(false, Ordering::Release);
        let subscribed: Vec<Topic> = lock(&shared.confirmed).iter().cloned().collect();
        if !subscribed.is_empty() {
            // The scene may start with this answer: what was used before belongs to no frame.
            if !mem::replace(&mut self.is_start_reported, true) {
                // Ahead of the first tick, which waits for the answer.
                self.stats(Priority::InteractiveHigh);
            }
            let process = self.identity.process.clone();
            let key = Topic::Ready(process.clone()).in_run(&self.identity.run);
            let ready = Control::Ready {
                process,
                subscribed,
            };
            self.put(&key, Priority::InteractiveHigh, 0, ready);
        }
    }

    fn stats(&mut self, priority: Priority) {
        let process = self.identity.process.clone();
        let key = Key::stats(&self.identity.run, &process);
        let stats = Stats {
            process,
            ledger: self.stats.ledger(),
            stages: self.stats.stages(),
            usage: process_usage(),
            traffic: self.stats.traffic(),
            problems: self.stats.problems(),
        };
        self.put(&key, priority, 0, stats);
    }

    fn put<M: Payload>(&mut self, key: &Key, priority: Priority, capture_nanos: u64, message: M) {
        let cav = &self.identity.cav;
        let stamp = stamp_now(cav, self.epoch, self.sequence, capture_nanos);
        self.sequence += 1;
        let encoded = match wire::encode(&stamp, message) {
            Ok(encoded) => encoded,
            Err(error) => return tracing::error!(%key, "status cannot be sent: {error}"),
        };
        let put = self.session.put(key.to_string(), payload(encoded));
        let put = put.congestion_control(CongestionControl::Block);
        let put = put.priority(priority).express(true);
        if let Err(cause) = put.wait() {
            tracing::error!(%key, "zenoh rejected a status: {cause}");
        }
    }
}
