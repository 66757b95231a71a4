//! Start barrier of a scene: no clock starts before every route has carried a message.
//!
//! A message published before its route exists is lost without an error, and a matching subscriber is not necessarily
//! the expected one. So every publisher sends probes on its real key until its first real message, every subscriber
//! answers each probe on `ready/<process>`, and the process that holds the clock waits until all expected routes are
//! confirmed.

use std::collections::BTreeSet;
use std::fmt;
use std::str::FromStr;
use std::sync::{Arc, Condvar, Mutex};
use std::time::{Duration, Instant};

use protocol::{CavId, Control, DropReason, KeyExpr, Limits, Principal, ProcessId, Role, Topic};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use support::sync::{lock, spawn, wait_at_most};

use super::bounded_queue::Pop;
use super::{Bus, BusError, Event, Inbox, Subscription};

/// Queued answers of one process: each repeats the content of the previous one.
const PLACES: usize = 1;
/// Maximum number of processes with queued answers; a run of 64 vehicles has fewer.
const MAX_PROCESSES: usize = 256;

/// Interval at which a waiting barrier checks whether it should still wait.
const POLL_PERIOD: Duration = Duration::from_millis(100);
/// Maximum number of routes in an error text.
const MAX_LISTED: usize = 20;

/// From the publisher of a topic to one subscribing process, written `4279/lidar>agent-4279`.
#[derive(
    Debug, Clone, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize, JsonSchema,
)]
#[serde(try_from = "String", into = "String")]
pub struct Route {
    /// Topic of the publisher.
    pub topic: Topic,
    /// Subscribing process.
    pub receiver: ProcessId,
}

impl Route {
    /// The route of a topic to a process.
    pub fn new(topic: Topic, receiver: ProcessId) -> Self {
        Self { topic, receiver }
    }

    fn parse(text: &str) -> Result<Self, String> {
        let (topic, receiver) = text.split_once('>').ok_or("there is no '>'")?;
        let topic = topic.parse::<Topic>().map_err(|cause| cause.to_string())?;
        let receiver = receiver.parse::<ProcessId>();
        let receiver = receiver.map_err(|cause| cause.to_string())?;
        Ok(Self { topic, receiver })
    }
}

impl fmt::Display for Route {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}>{}", self.topic, self.receiver)
    }
}

/// The name of a process in ledgers and routes: `agent-4279`, or the role if the vehicle is only a placeholder for it
/// (`replay`).
pub fn process_id(role: Role, cav: &CavId) -> ProcessId {
    Principal::new(role, cav).name()
}

impl FromStr for Route {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        Self::parse(text).map_err(|detail| {
            let shown: String = text.chars().take(100).collect();
            format!(
                "{shown:?} is not a route TOPIC>PROCESS such as 4279/lidar>agent-4279: {detail}"
            )
        })
    }
}

protocol::written_as_text!(Route);

/// Some routes are not confirmed.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("no message within {:.1} s on {}{}; is that process running, and in the same run?", .waited.as_secs_f64(),
    .missing.iter().take(MAX_LISTED).map(ToString::to_string).collect::<Vec<_>>().join(", "),
    if .missing.len() > MAX_LISTED { format!(" and {} more", .missing.len() - MAX_LISTED) } else { String::new() })]
pub struct NotReady {
    /// Routes without an answer, in order.
    pub missing: Vec<Route>,
    /// Waiting time.
    pub waited: Duration,
}

/// Routes that are not confirmed yet.
#[derive(Default)]
pub struct Barrier {
    missing: Mutex<BTreeSet<Route>>,
    changed: Condvar,
}

impl Barrier {
    /// A barrier that opens when all of `expected` are confirmed; at once if there are none.
    pub fn new(expected: impl IntoIterator<Item = Route>) -> Self {
        let missing = Mutex::new(expected.into_iter().collect());
        let changed = Condvar::new();
        Self { missing, changed }
    }

    /// Subscribes on `bus` to the answers to probes.
    ///
    /// # Errors
    /// [`BusError`] when the bus is closed or the system cannot start a thread.
    pub fn await_routes(self, bus: &Bus) -> Result<RoutesReady, BusError> {
        let (barrier, inbox) = (Arc::new(self), bus.inbox(PLACES, MAX_PROCESSES));
        let subscription = bus.subscribe_all(&KeyExpr::ready(&bus.identity().run), &inbox)?;
        let attending = (Arc::clone(&barrier), Arc::clone(&inbox));
        let listening = spawn("readiness", move || attending.0.listen(&attending.1));
        listening.map_err(BusError::thread("readiness"))?;
        Ok(RoutesReady {
            barrier,
            inbox,
            _subscription: subscription,
        })
    }

    fn listen(&self, inbox: &Inbox) {
        // Ends when the inbox is closed, with the `RoutesReady` that holds it.
        while let Pop::Item(topic, event) = inbox.take(None) {
            let (Topic::Ready(sender), Event::Message(arrival)) = (&topic, event) else {
                continue;
            };
            match inbox.decode(&arrival, &Limits::DEFAULT) {
                // A process may confirm its own routes only.
                Some(Control::Ready {
                    process,
                    subscribed,
                }) if process == *sender => {
                    for topic in subscribed {
                        self.confirm(&Route::new(topic, sender.clone()));
                    }
                }
                Some(_) => {
                    let why = "not the sender's own readiness";
                    inbox.stats.reject(&topic, DropReason::Identity, why);
                }
                None => {}
            }
        }
    }

    /// Marks `route` as confirmed. Routes that are not expected change nothing.
    fn confirm(&self, route: &Route) {
        if lock(&self.missing).remove(route) {
            self.changed.notify_all();
        }
    }

    /// Routes still missing.
    pub fn missing(&self) -> Vec<Route> {
        lock(&self.missing).iter().cloned().collect()
    }

    /// Waits until the barrier is open, at most for `timeout`.
    ///
    /// # Errors
    /// [`NotReady`] lists the missing routes.
    pub fn wait(&self, timeout: Duration) -> Result<(), NotReady> {
        self.wait_unless(timeout, || false)
    }

    /// [`Self::wait`] that gives up as soon as `given_up` returns true.
    ///
    /// # Errors
    /// [`NotReady`] lists the missing routes.
    pub fn wait_unless(
        &self,
        timeout: Duration,
        given_up: impl Fn() -> bool,
    ) -> Result<(), NotReady> {
        let began = Instant::now();
        let mut missing = lock(&self.missing);
        while !missing.is_empty() {
            let left = timeout.saturating_sub(began.elapsed());
            if left.is_zero() || given_up() {
                let (missing, waited) = (missing.iter().cloned().collect(), began.elapsed());
                return Err(NotReady { missing, waited });
            }
            // Short waits: nothing wakes this thread when `given_up` becomes true.
            let pause = left.min(POLL_PERIOD);
            missing = wait_at_most(&self.changed, missing, pause);
        }
        Ok(())
    }
}

/// A [`Barrier`] that receives the answers to probes, until it is dropped.
pub struct RoutesReady {
    barrier: Arc<Barrier>,
    inbox: Arc<Inbox>,
    _subscription: Subscription,
}

impl std::ops::Deref for RoutesReady {
    type Target = Barrier;

    fn deref(&self) -> &Barrier {
        &self.barrier
    }
}

impl Drop for RoutesReady {
    fn drop(&mut self) {
        self.inbox.close();
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn route(text: &str) -> Route {
        text.parse().unwrap()
    }

    #[test]
    fn routes_are_written_and_read_back() {
        for text in [
            "4279/lidar>agent-4279",
            "truth>scorer",
            "rx/4279/4288/bev>ego-4279",
        ] {
            assert_eq!(route(text).to_string(), text);
        }
        for (text, expected) in [
            ("4279/lidar", "'>'"),
            ("4279/nothing>a", "key"),
            ("truth>A", "process name"),
        ] {
            let error = text.parse::<Route>().unwrap_err().to_string();
            assert!(error.contains(expected), "{error}");
        }
    }

    #[test]
    fn processes_are_named_by_role_and_vehicle() {
        assert_eq!(
            process_id(Role::Agent, &CavId::new("-1").unwrap()).as_str(),
            "agent--1"
        );
        assert_eq!(
            process_id(Role::Replay, &CavId::new("replay").unwrap()).as_str(),
            "replay"
        );
        assert_eq!(
            process_id(Role::Replay, &CavId::new(&"z".repeat(32)).unwrap())
                .as_str()
                .len(),
            39
        );
    }

    #[test]
    fn opens_when_all_routes_are_confirmed() {
        let barrier = Barrier::new([route("1/lidar>a"), route("2/lidar>b")]);
        barrier.confirm(&route("1/lidar>a"));
        barrier.confirm(&route("3/lidar>c"));
        let error = barrier.wait(Duration::from_millis(5)).unwrap_err();
        assert_eq!(error.missing, [route("2/lidar>b")]);
        assert!(error.to_string().contains("2/lidar>b"), "{error}");
        std::thread::scope(|scope| {
            let waiting = scope.spawn(|| barrier.wait(Duration::from_secs(60)));
            barrier.confirm(&route("2/lidar>b"));
            assert_eq!(waiting.join().unwrap(), Ok(()));
        });
    }

    #[test]
    fn an_error_does_not_list_a_thousand_routes() {
        let barrier = Barrier::new((0..1000).map(|index| route(&format!("{index}/lidar>a"))));
        let text = barrier.wait(Duration::ZERO).unwrap_err().to_string();
        assert!(text.contains("and 980 more") && text.len() < 1000, "{text}");
    }
}
