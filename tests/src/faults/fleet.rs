//! Fleet under faults: `v2vloc up` on a small scene, over virtual links that can be cut.

use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::path::Path;
use std::sync::{Arc, Mutex, PoisonError};
use std::thread;
use std::time::{Duration, Instant};

use bus::{BusError, BusOptions, Endpoint, open};
use deploy::operate::health::Usage;
use protocol::HEADER_LEN;
use zenoh::{Session, Wait};

use super::{Fault, Findings, Kind, Proxy, Results, Target, VEHICLES, unix_ms, write_scenario};
use crate::bus::{free_port, wait_for};
use crate::fleet::{Up, signal};

/// Time between two ticks of the scene.
const PERIOD_MS: u64 = 100;
/// Number of results in a row with every vehicle's data, after which the fleet has recovered.
const SETTLED: usize = 5;
/// Longest time until then.
const TIMEOUT: Duration = Duration::from_secs(60);
/// Age at which a process has opened all its descriptors.
const SETTLED_AGE: Duration = Duration::from_secs(5);

/// Time of the first message, by vehicle and epoch, milliseconds on the Unix clock.
type FirstMessages = BTreeMap<(String, u64), u64>;

/// A fleet under faults.
pub struct FaultyFleet {
    up: Up,
    proxy: Proxy,
    router: Option<Session>,
    router_endpoint: Endpoint,
    first_messages: Arc<Mutex<FirstMessages>>,
    _observer: Session,
    results: Results,
    shared_memory: BTreeSet<String>,
    /// First and last usage of each process instance above that age.
    usage: BTreeMap<u32, (String, Instant, Option<[Usage; 2]>)>,
    findings: Findings,
}

/// Results of the faults.
#[derive(Debug)]
pub struct Report {
    /// Gaps and returns.
    pub findings: Findings,
    /// Longest time from the end of a fault to recovery, milliseconds, and the fault.
    pub slowest: (u64, String),
    /// True if the ledgers of all processes balance.
    pub balances: bool,
    /// Description of the discrepancies.
    pub discrepancies: String,
    /// Number of messages that are exempt, as a process that they concern was offline.
    pub exempted: u64,
    /// From Ctrl-C to the end.
    pub stop: Duration,
    /// Files in shared memory that did not exist before.
    pub left_over: Vec<String>,
    /// Largest growth of descriptors and of threads in any instance of a process, with its name.
    pub growth: [(i64, String); 2],
    /// Number of restarts.
    pub restarts: u64,
}

impl FaultyFleet {
    /// Starts a fleet of [`VEHICLES`] in `folder` and waits until all are fused.
    ///
    /// # Panics
    /// When it does not reach that state.
    #[must_use]
    pub fn start(folder: &Path) -> Self {
        let shared_memory = shared_memory();
        let port = free_port();
        let router_endpoint = Endpoint::loopback(port);
        let router = route(&router_endpoint).expect("a router");
        let proxy = Proxy::open(port);
        let first_messages = Arc::<Mutex<FirstMessages>>::default();
        let observer = observe(&router_endpoint, &first_messages);
        let rest = format!(
            "network: {{connect: {}}}\nlink: {{model: ideal}}\ntimeouts: {{restarts: 1000000}}",
            proxy.endpoint.as_str()
        );
        let scenario = write_scenario(folder, &rest);
        let up = Up::start(folder, &scenario);
        let results = Results::of(&up.folder);
        let mut fleet = Self {
            up,
            proxy,
            router: Some(router),
            router_endpoint,
            first_messages,
            _observer: observer,
            results,
            shared_memory,
            usage: BTreeMap::new(),
            findings: Findings::default(),
        };
        fleet
            .settle(0, None, "the start")
            .expect("a fleet that starts");
        fleet
    }

    /// Injects one fault after another, each after recovery from the previous one.
    ///
    /// # Panics
    /// When the fleet does not recover.
    #[must_use]
    pub fn suffer(
        mut self,
        faults: &[Fault],
        mut on_recovery: impl FnMut(usize, &Fault, u64),
    ) -> Report {
        let mut slowest = (0, String::new());
        let mut settled_ms = unix_ms();
        for (number, fault) in faults.iter().enumerate() {
            thread::sleep(fault.after);
            let began_ms = unix_ms();
            let before = self.up.pids();
            self.act(fault, &before);
            let ended_ms = unix_ms();
            let gone = match (&fault.target, fault.kind) {
                (Target::Process(name), Kind::Kill | Kind::End) => {
                    Some((name.as_str(), before[name]))
                }
                _ => None,
            };
            if let Err(problem) = self.settle(ended_ms, gone, &fault.to_string()) {
                panic!("fault {number}, {fault}: {problem}");
            }
            let now_ms = unix_ms();
            if now_ms - ended_ms > slowest.0 {
                slowest = (now_ms - ended_ms, fault.to_string());
            }
            let results = self.results.update();
            if !fault.silences_ego() {
                self.findings.add_gaps(
                    results,
                    [settled_ms, now_ms],
                    PERIOD_MS,
                    &fault.to_string(),
                );
            }
            let first_messages = self
                .first_messages
                .lock()
                .unwrap_or_else(PoisonError::into_inner);
            let new = first_messages
                .iter()
                .filter(|((cav, _), at)| **at >= began_ms && cav != VEHICLES[0]);
            let new: BTreeMap<String, u64> = new.map(|((cav, _), at)| (cav.clone(), *at)).collect();
            self.findings.add_returns(results, &new);
            drop(first_messages);
            self.read_usage();
            on_recovery(number, fault, now_ms - ended_ms);
            settled_ms = now_ms;
        }
        self.end(slowest)
    }

    fn act(&mut self, fault: &Fault, pids: &BTreeMap<String, u32>) {
        let Target::Process(name) = &fault.target else {
            let router = self.router.take().expect("it is there");
            // The result does not matter.
            let _ = router.close().wait();
            thread::sleep(fault.lasts);
            let endpoint = self.router_endpoint.clone();
            wait_for("the router's port", || {
                self.router = route(&endpoint).ok();
                self.router.is_some()
            });
            return;
        };
        let pid = pids[name];
        match fault.kind {
            Kind::Kill => signal(pid, "KILL"),
            Kind::End => signal(pid, "TERM"),
            Kind::Stop => {
                signal(pid, "STOP");
                thread::sleep(fault.lasts);
                signal(pid, "CONT");
            }
            Kind::Cut => drop(self.proxy.cut(pid)),
            Kind::Silence => {
                self.proxy.silence(pid, true);
                thread::sleep(fault.lasts);
                self.proxy.silence(pid, false);
            }
        }
    }

    /// Waits until results published after `after_ms` have every vehicle's data again; `gone` is a process that has to
    /// be restarted, with its previous id.
    fn settle(
        &mut self,
        after_ms: u64,
        gone: Option<(&str, u32)>,
        what: &str,
    ) -> std::result::Result<(), String> {
        let deadline = Instant::now() + TIMEOUT;
        loop {
            let is_back = gone
                .is_none_or(|(name, pid)| self.up.pids().get(name).is_some_and(|now| *now != pid));
            // A feature map of the previous instance may be recent enough for a while.
            let after_ms = match gone {
                Some((name, _)) => name
                    .strip_prefix("agent-")
                    .map_or(Some(after_ms), |cav| self.back(cav, after_ms)),
                None => Some(after_ms),
            };
            let results = self.results.update();
            let newest = &results[results.len().saturating_sub(SETTLED)..];
            let is_whole = newest.len() == SETTLED
                && after_ms.is_some_and(|after_ms| newest[0].published_ms > after_ms)
                && newest
                    .iter()
                    .all(|result| result.fused.len() == VEHICLES.len() - 1);
            if is_back && is_whole {
                return Ok(());
            }
            if Instant::now() > deadline {
                return Err(format!(
                    "after {what} not all are fused again; the last results: {newest:?}"
                ));
            }
            thread::sleep(Duration::from_millis(20));
        }
    }

    /// Time of the first message of a vehicle's instance that began after `after_ms`.
    fn back(&self, cav: &str, after_ms: u64) -> Option<u64> {
        let first_messages = self
            .first_messages
            .lock()
            .unwrap_or_else(PoisonError::into_inner);
        first_messages
            .iter()
            .filter(|((known, _), at)| known == cav && **at >= after_ms)
            .map(|(_, at)| *at)
            .max()
    }

    fn read_usage(&mut self) {
        let now = Instant::now();
        let own = [("v2vloc".to_owned(), self.up.pid())];
        for (name, pid) in self.up.pids().into_iter().chain(own) {
            let (_, since, usage) = self.usage.entry(pid).or_insert((name, now, None));
            if let Some(found) =
                Usage::of(pid).filter(|_| now.duration_since(*since) >= SETTLED_AGE)
            {
                usage.get_or_insert([found; 2])[1] = found;
            }
        }
    }

    fn end(mut self, slowest: (u64, String)) -> Report {
        let asked = Instant::now();
        signal(self.up.pid(), "INT");
        let status = self.up.wait();
        let stop = asked.elapsed();
        assert!(matches!(status.code(), Some(0 | 3)), "{status}");
        let text = fs::read_to_string(self.up.folder.join("ledger.json")).expect("a ledger");
        let ledger: serde_json::Value = serde_json::from_str(&text).expect("JSON");
        let status = deploy::operate::status::RunStatus::read(&self.up.folder).expect("a status");
        let growth_of = |field: fn(&Usage) -> Option<u64>| {
            let growth = |(name, _, usage): &(String, Instant, Option<[Usage; 2]>)| {
                let [first, last] = (*usage)?;
                Some((field(&last)? as i64 - field(&first)? as i64, name.clone()))
            };
            self.usage
                .values()
                .filter_map(growth)
                .max()
                .unwrap_or_default()
        };
        Report {
            findings: self.findings.clone(),
            slowest,
            balances: ledger["balances"] == true,
            discrepancies: ledger["balance"].to_string(),
            exempted: ledger["exempted"].as_u64().unwrap_or(0),
            stop,
            left_over: shared_memory()
                .difference(&self.shared_memory)
                .cloned()
                .collect(),
            growth: [
                growth_of(|usage| usage.descriptors),
                growth_of(|usage| usage.threads),
            ],
            restarts: status
                .processes
                .iter()
                .map(|process| u64::from(process.restarts))
                .sum(),
        }
    }
}

fn route(endpoint: &Endpoint) -> std::result::Result<Session, BusError> {
    open(&BusOptions::router(endpoint.clone()))
}

/// Subscribes to every vehicle's pose, and records the first message of each instance.
fn observe(router: &Endpoint, first_messages: &Arc<Mutex<FirstMessages>>) -> Session {
    let session = open(&BusOptions::client(router.clone())).expect("the router is there");
    let first_messages = Arc::clone(first_messages);
    let subscriber = session
        .declare_subscriber("v2v/test/*/pose")
        .callback(move |sample| {
            let bytes = sample.payload().to_bytes();
            let header = bytes
                .get(..HEADER_LEN)
                .and_then(|bytes| protocol::Header::from_bytes(bytes.try_into().ok()?).ok());
            if let Some(stamp) = header.map(|header| header.stamp) {
                let mut first_messages = first_messages
                    .lock()
                    .unwrap_or_else(PoisonError::into_inner);
                first_messages
                    .entry((stamp.cav.to_string(), stamp.epoch))
                    .or_insert(stamp.publish_nanos / 1_000_000);
            }
        });
    subscriber.background().wait().expect("a subscriber");
    session
}

fn shared_memory() -> BTreeSet<String> {
    let entries = fs::read_dir("/dev/shm").into_iter().flatten().flatten();
    entries
        .map(|entry| entry.file_name().to_string_lossy().into_owned())
        .collect()
}
